/* ------------------------------------------------------------------------------------
   Small dense algebra. Matrices are rows one after the other, without gaps.
   --------------------------------------------------------------------------------- */

#ifdef __cplusplus
#define restrict /* a build that takes C for C++ knows none */
#endif

typedef gpmpc_real real;

/* The sums of GPs are taken in double, or in whole numbers, whatever the precision is:
   a GP of smooth dynamics is a sum of large terms that cancel, of which float would
   leave no digit. */
typedef double wide;

enum {
    n = GPMPC_STATES,
    m = GPMPC_INPUTS,
    H = GPMPC_HORIZON,
    r = GPMPC_ROWS,
    N = GPMPC_SIZE
};

/* b where either is NaN, as in ``smaller`` */
static real larger(real a, real b) { return a > b ? a : b; }

static real smaller(real a, real b) { return a < b ? a : b; }

static real absolute(real a) { return a < 0 ? -a : a; }

static int is_finite(real a) { return a - a == 0; }

/* Sensors mark with the largest numbers of their type what they did not see. */
static int is_measured(real a) { return absolute(a) < (real)1e30; }

static int all_measured(const real *x, int size)
{
    int i;
    for (i = 0; i < size; i++)
        if (!is_measured(x[i]))
            return 0;
    return 1;
}

static int all_finite(const real *x, int size)
{
    int i;
    for (i = 0; i < size; i++)
        if (!is_finite(x[i]))
            return 0;
    return 1;
}

static void copy(const real *x, real *y, int size)
{
    int i;
    for (i = 0; i < size; i++)
        y[i] = x[i];
}

static void fill(real *x, real value, int size)
{
    int i;
    for (i = 0; i < size; i++)
        x[i] = value;
}

/* x'y; long ones in eight interleaved parts, which need not wait for each other. Those
   of GPs are summed in parts at every length and in double: ``wide_dot``. */
static real dot(const real *x, const real *y, int size)
{
    real total = 0;
    int i = 0;
    if (size >= 32) {
        real parts[8] = {0};
        int lane;
        for (; i + 8 <= size; i += 8)
            for (lane = 0; lane < 8; lane++)
                parts[lane] += x[i + lane] * y[i + lane];
        total = ((parts[0] + parts[4]) + (parts[2] + parts[6]))
                + ((parts[1] + parts[5]) + (parts[3] + parts[7]));
    }
    for (; i < size; i++)
        total += x[i] * y[i];
    return total;
}

/* y <- y + factor x */
static void add_scaled(real factor, const real *x, real *y, int size)
{
    int i;
    for (i = 0; i < size; i++)
        y[i] += factor * x[i];
}

/* y <- y + sum_j (sign factors_j) x_j for rows x_j of N numbers, of which the first
   ``size`` count; the factors lie ``step`` apart. Four rows at a time, so that y is read
   and written once for them. */
static void add_combination(real sign, const real *factors, int step,
                            real (*x)[GPMPC_SIZE], int count, real *restrict y,
                            int size)
{
    int i, j;
    for (j = 0; j + 4 <= count; j += 4) {
        const real *first = x[j];
        const real *second = x[j + 1];
        const real *third = x[j + 2];
        const real *fourth = x[j + 3];
        real factor1 = sign * factors[j * step];
        real factor2 = sign * factors[(j + 1) * step];
        real factor3 = sign * factors[(j + 2) * step];
        real factor4 = sign * factors[(j + 3) * step];
        for (i = 0; i < size; i++) {
            real sum = y[i] + factor1 * first[i];
            sum += factor2 * second[i];
            sum += factor3 * third[i];
            y[i] = sum + factor4 * fourth[i];
        }
    }
    for (; j < count; j++)
        add_scaled(sign * factors[j * step], x[j], y, size);
}

/* out <- A x, A (rows, columns) */
static void multiply(const real *A, const real *x, int rows, int columns, real *out)
{
    int i;
    for (i = 0; i < rows; i++)
        out[i] = dot(A + i * columns, x, columns);
}

/* out <- A B, A (rows, inner), B (inner, columns) */
static void product(const real *A, const real *B, int rows, int inner, int columns,
                    real *out)
{
    int i, j;
    for (i = 0; i < rows; i++) {
        fill(out + i * columns, 0, columns);
        for (j = 0; j < inner; j++)
            add_scaled(A[i * inner + j], B + j * columns, out + i * columns, columns);
    }
}

/* out <- out + A'B, A (inner, rows), B (inner, columns) */
static void add_transposed_product(const real *A, const real *B, int inner, int rows,
                                   int columns, real *out)
{
    int i, j;
    for (j = 0; j < inner; j++)
        for (i = 0; i < rows; i++)
            add_scaled(A[j * rows + i], B + j * columns, out + i * columns, columns);
}

/* The whole turns in a difference of angles. */
static real whole_turns(real angle)
{
    const real turn = REAL(6.283185307179586476925286766559);
    return turn * ROUND_EVEN(angle / turn);
}

/* X <- A^-1 X, A (size, size) positive definite, X (size, columns); A is lost */
static int solve_positive(real *A, int size, real *X, int columns)
{
    int i, j;
    for (i = 0; i < size; i++) {
        real pivot;
        for (j = 0; j < i; j++)
            A[i * size + j] = (A[i * size + j] - dot(A + i * size, A + j * size, j))
                              / A[j * size + j];
        pivot = A[i * size + i] - dot(A + i * size, A + i * size, i);
        if (!(pivot > 0))
            return 0;
        A[i * size + i] = SQRT(pivot);
    }
    for (i = 0; i < size; i++) { /* L^-1 X */
        for (j = 0; j < i; j++)
            add_scaled(-A[i * size + j], X + j * columns, X + i * columns, columns);
        for (j = 0; j < columns; j++)
            X[i * columns + j] /= A[i * size + i];
    }
    for (i = size - 1; i >= 0; i--) { /* L^-T L^-1 X */
        for (j = i + 1; j < size; j++)
            add_scaled(-A[j * size + i], X + j * columns, X + i * columns, columns);
        for (j = 0; j < columns; j++)
            X[i * columns + j] /= A[i * size + i];
    }
    return 1;
}

/*{pairs}*/

/*{generated}*/

/* ------------------------------------------------------------------------------------
   The local problem: the plan that a step starts from, and its stages.
   --------------------------------------------------------------------------------- */

enum { INPUTS, DEVIATIONS, INCREMENTS }; /* what R weighs */

/* Weight Q (n, n) of s_{k+1} on the way. */
static const real *running_weight(int k)
{
    return state_weights + (GPMPC_STATE_WEIGHTS > 1 ? k : 0) * n * n;
}

/* Weight (n, n) of s_{k+1}; that of s_H is the terminal one. */
static const real *weight_of_stage(int k)
{
    return k == H - 1 ? terminal_weight : running_weight(k);
}

/* Weight R (m, m) of the input of stage k. */
static const real *input_weight(int k)
{
    return input_weights + (GPMPC_INPUT_WEIGHTS > 1 ? k : 0) * m * m;
}

/* The input that was applied last; the initial one where none was, or no number. */
static const real *last_input(const gpmpc_controller *controller)
{
    if (controller->has_input && all_finite(controller->input, m))
        return controller->input;
    return initial_input;
}

/* Index of the stage model of stage k: of H, or the one that is held. */
static int stage_of(int k) { return GPMPC_STAGES > 1 ? k : 0; }

/* An input within its box at stage k; one that is no number stays so. */
static real within_box(real u, int k, int i)
{
    return smaller(input_upper[k * m + i], larger(input_lower[k * m + i], u));
}

/* An input within its rates from the one before it, where there are any. */
static real within_rates(real u, real last, int k, int i)
{
    if (!GPMPC_HAS_RATES)
        return u;
    return smaller(last + rate_upper[k * m + i],
                   larger(last + rate_lower[k * m + i], u));
}

/* Entry i of what the last plan means for stage k: its mean one step later, the last
   one repeated. An angle, which may be counted from another turn since, is moved by the
   full turns between the state and the mean that was predicted for it. */
static real continued_mean(const gpmpc_controller *controller, const real *state,
                           int k, int i, const int *angles, int count)
{
    real mean = controller->means[k + 1 < H ? k + 1 : H][i];
    int a;
    for (a = 0; a < count; a++)
        if (angles[a] == i)
            mean += whole_turns(state[i] - controller->means[1][i]);
    return mean;
}

/* Reads the reference; its angles move by full turns towards the last plan, or without
   one towards the stage before. */
static void read_reference(gpmpc_controller *controller, const real *state,
                           const gpmpc_reference *reference)
{
    gpmpc_problem *problem = &controller->problem;
    int k, i, a;
    for (k = 0; k <= H; k++) {
        copy(reference->states[k], problem->targets[k], n);
        for (a = 0; a < GPMPC_COST_ANGLE_COUNT; a++) {
            real plan;
            i = cost_angles[a];
            plan = k > 0 ? problem->targets[k - 1][i] : state[i];
            if (k > 0 && controller->has_plan)
                plan = continued_mean(controller, state, k, i, cost_angles,
                                      GPMPC_COST_ANGLE_COUNT);
            problem->targets[k][i] += whole_turns(plan - problem->targets[k][i]);
        }
    }
    for (k = 0; k < H; k++)
        for (i = 0; i < m; i++)
            problem->target_inputs[k][i] =
                reference->has_inputs ? reference->inputs[k][i] : 0;
}

/* The states of the first guess: the last plan, one step on. Without one a line from
   the state to the last reference. Form velocity holds the state. */
static void guess_states(gpmpc_controller *controller, const real *state)
{
    gpmpc_problem *problem = &controller->problem;
    int k, i;
    copy(state, problem->states[0], n);
    for (k = 1; k <= H; k++) {
        real remaining = 1 - (real)k * ((real)1 / H);
        for (i = 0; i < n; i++) {
            real mean;
            if (GPMPC_HELD)
                mean = state[i];
            else if (controller->has_plan)
                mean = continued_mean(controller, state, k, i, state_angles,
                                      GPMPC_STATE_ANGLE_COUNT);
            else
                mean = problem->targets[k][i]
                       + remaining * (state[i] - problem->targets[1][i]);
            problem->states[k][i] = mean;
        }
    }
}

/* Its inputs, within bounds and rates: the last plan, one step on. Without one those of
   the reference where deviations from them are weighed, else the previous input. Form
   velocity holds the previous input. */
static void guess_inputs(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    int k, i;
    for (k = 0; k < H; k++)
        for (i = 0; i < m; i++) {
            real last = k > 0 ? problem->inputs[k - 1][i] : problem->previous_input[i];
            real input = problem->previous_input[i];
            if (GPMPC_HELD) {
                problem->inputs[k][i] = input;
                continue;
            }
            if (controller->has_plan)
                input = controller->inputs[k + 1 < H ? k + 1 : H - 1][i];
            else if (GPMPC_PENALIZED == DEVIATIONS)
                input = problem->target_inputs[k][i];
            problem->inputs[k][i] = within_rates(within_box(input, k, i), last, k, i);
        }
}

/* Whether the policy has moved the plan on to its last stage, or beyond: it then says
   nothing of where the plant is. */
static int is_used_up(const gpmpc_controller *controller)
{
    return controller->policy_steps > 0 && controller->policy_steps > H - 2;
}

/* d <- (1 - L) d + L (x - f(x', u')): what the last step showed of a constant error;
   after steps of the policy it is the mean of all. Without a plan it stays. */
static void estimate_disturbance(gpmpc_controller *controller, const real *state)
{
    real mean[GPMPC_STATES];
    real error[GPMPC_STATES];
    real gain = GPMPC_DISTURBANCE_GAIN / (1 + (real)controller->policy_steps);
    int i, a;
    if (!controller->has_plan || is_used_up(controller))
        return;
    model(controller->means[0], controller->problem.previous_input,
          &controller->problem.work, mean, 0, 0);
    for (i = 0; i < n; i++) {
        error[i] = state[i] - mean[i];
        for (a = 0; a < GPMPC_STATE_ANGLE_COUNT; a++)
            if (state_angles[a] == i)
                error[i] -= whole_turns(error[i]);
    }
    if (!all_finite(error, n)) /* the model has no numbers there */
        return;
    for (i = 0; i < n; i++)
        controller->estimate[i] += gain * (error[i] - controller->estimate[i]);
}

#if GPMPC_TUBES
/* Writes the model's covariances of the stages first .. last - 1, whose kernels were
   kept, and the process noise to them. */
static void write_model_covariances(gpmpc_problem *problem, int first, int last)
{
    real variance[GPMPC_LANES * GPMPC_AT_LEAST_ONE(GPMPC_GP_OUTPUTS)];
    int k;
    model_variances(&problem->work, variance);
    for (k = first; k < last; k++) {
        real *V = &problem->V[k][0][0];
        model_covariance(variance + (k - first) * GPMPC_GP_OUTPUTS, V);
        add_scaled(1, process_noise, V, n * n);
    }
}
#endif

/* c <- after - A s - B u of entry i at stage k, where the plan leads from s to ``after``
   by u; in float with what it rounds off: states are large beside what they change. */
static void write_offset(gpmpc_problem *problem, int k, int i, real after,
                         const real *s, const real *u)
{
    const real *A = problem->A[k][i];
    const real *B = problem->B[k][i];
#if GPMPC_IS_FLOAT
    Pair offset = pair_of(after, 0);
    int j;
    for (j = 0; j < n; j++)
        add_multiple(&offset, -A[j], pair_of(s[j], 0));
    for (j = 0; j < m; j++)
        add_multiple(&offset, -B[j], pair_of(u[j], 0));
    offset = normalised(offset);
    problem->c[k][i] = offset.high;
    problem->c_low[k][i] = offset.low;
#else
    problem->c[k][i] = after - (dot(A, s, n) + dot(B, u, m));
#endif
}

/* Whether a plan may lead from a state to ``after`` where the model leads to ``next``:
   not where these are further apart than the data are wide, twice, or no numbers. */
static int is_motion(real next, real after, int i)
{
    real distance = absolute(next - after);
#if GPMPC_KNOWS_RANGES
    if (!(distance <= 2 * data_ranges[i]))
        return 0;
#else
    (void)i;
#endif
    return is_finite(distance);
}

/* Linearises the dynamics along the plan: c = f(s, u) + d - A s - B u. Returns whether
   the plan is a motion, nearly; one stage that is held always is. */
static int linearize(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_work *work = &problem->work;
    real next[GPMPC_STATES];
    int moves = 1;
    int k, i;
    for (k = 0; k < GPMPC_STAGES; k++) {
        const real *s = problem->states[k];
        const real *u = problem->inputs[k];
#if GPMPC_TUBES
        work->lane = k % GPMPC_LANES;
#endif
        model(s, u, work, next, &problem->A[k][0][0], &problem->B[k][0][0]);
        for (i = 0; i < n; i++) {
            real after = next[i] + (GPMPC_ESTIMATES ? controller->estimate[i] : 0);
            write_offset(problem, k, i, after, s, u);
            if (!GPMPC_HELD)
                moves = moves && is_motion(after, problem->states[k + 1][i], i);
        }
        if (!GPMPC_HELD)
            moves = moves && all_finite(&problem->A[k][0][0], n * n)
                    && all_finite(&problem->B[k][0][0], n * m);
#if GPMPC_TUBES
        if (work->lane == GPMPC_LANES - 1 || k == GPMPC_STAGES - 1)
            write_model_covariances(problem, k - work->lane, k + 1);
#endif
    }
    work->lane = -1;
    return moves;
}

/* Replaces the states of the first guess by those that its inputs lead to, or by the
   first one where these are not finite. */
static void follow_inputs(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    int k, i;
    for (k = 0; k < H; k++) {
        model(problem->states[k], problem->inputs[k], &problem->work,
              problem->states[k + 1], 0, 0);
        for (i = 0; i < n && GPMPC_ESTIMATES; i++)
            problem->states[k + 1][i] += controller->estimate[i];
    }
    if (!all_finite(&problem->states[0][0], (H + 1) * n))
        for (k = 1; k <= H; k++)
            copy(problem->states[0], problem->states[k], n);
}

#if GPMPC_HELD
/* Shares what the plan, moved by full turns (n), did not foresee out over the steps
   of the policy. */
static void share_step_model(gpmpc_controller *controller, const real *turns)
{
    gpmpc_problem *problem = &controller->problem;
    const int planned = H > 1 ? 2 : 1; /* a plan of one stage is used up */
    real before[GPMPC_STATES];
    real c[GPMPC_STATES];
    real share = 1 / (1 + (real)controller->policy_steps);
    int i;
#if GPMPC_IS_FLOAT
    real c_low[GPMPC_STATES];
    copy(problem->c_low[0], c_low, n);
#endif
    copy(problem->c[0], c, n);
    for (i = 0; i < n; i++)
        before[i] = controller->means[1][i] + turns[i];
    for (i = 0; i < n; i++) {
        write_offset(problem, 0, i, controller->means[planned][i] + turns[i], before,
                     controller->inputs[planned - 1]);
        problem->c[0][i] += (c[i] - problem->c[0][i]) * share;
#if GPMPC_IS_FLOAT
        problem->c_low[0][i] += (c_low[i] - problem->c_low[0][i]) * share;
#endif
    }
}

/* The held linearisation as that of the changes since the last step:
   c = s_0 - A s_{-1} - B u_{-1}, in which a constant error of the model cancels. */
static void write_step_model(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    real last[GPMPC_STATES];
    real turns[GPMPC_STATES];
    int i, a;
    fill(turns, 0, n);
    for (a = 0; a < GPMPC_STATE_ANGLE_COUNT; a++) {
        i = state_angles[a];
        turns[i] = whole_turns(problem->states[0][i] - controller->means[0][i]);
    }
    for (i = 0; i < n; i++)
        last[i] = controller->means[0][i] + turns[i];
    for (i = 0; i < n; i++)
        write_offset(problem, 0, i, problem->states[0][i], last,
                     problem->previous_input);
    if (controller->policy_steps > 0)
        share_step_model(controller, turns);
}
#endif

/* One stage of the Riccati recursion, from P_{k+1} to P_k (size, size):

     D = R + B'P B,   K = D^-1 B'P A
     P <- Q + K'R K + (A - B K)' P (A - B K)

   Q is NULL where it is not needed any more. */
static void riccati(const real *A, const real *B, const real *Q, const real *R,
                    int size, real *P, real *K, real *D)
{
    real PB[GPMPC_AUGMENTED * GPMPC_INPUTS];
    real closed[GPMPC_AUGMENTED * GPMPC_AUGMENTED];
    real PC[GPMPC_AUGMENTED * GPMPC_AUGMENTED];
    real factor[GPMPC_INPUTS * GPMPC_INPUTS];
    real RK[GPMPC_INPUTS * GPMPC_AUGMENTED];
    int i, j;
    product(P, B, size, size, m, PB);
    copy(R, D, m * m);
    add_transposed_product(B, PB, size, m, m, D);
    fill(K, 0, m * size);
    add_transposed_product(PB, A, size, m, size, K);
    copy(D, factor, m * m);
    if (!solve_positive(factor, m, K, size))
        fill(K, 0, m * size); /* no feedback where no gain can be told */
    if (!Q)
        return;
    product(B, K, size, m, size, closed);
    for (i = 0; i < size * size; i++)
        closed[i] = A[i] - closed[i];
    product(P, closed, size, size, size, PC);
    product(R, K, m, m, size, RK);
    copy(Q, P, size * size);
    add_transposed_product(closed, PC, size, size, size, P);
    add_transposed_product(K, RK, m, size, size, P);
    for (i = 0; i < size; i++) /* symmetric whatever is rounded */
        for (j = 0; j < i; j++) {
            real value = (P[i * size + j] + P[j * size + i]) / 2;
            P[i * size + j] = value;
            P[j * size + i] = value;
        }
}

#if GPMPC_TUBES || GPMPC_ROLLS_OUT || GPMPC_ELASTIC
/* Gains K_k of u = u_k - K_k (x - x_k), the regulator of the plan's own stages, weighed
   by Q and R of the first one, and by the terminal weight. */
static void write_gains(gpmpc_problem *problem)
{
    real P[GPMPC_STATES * GPMPC_STATES];
    real Q[GPMPC_STATES * GPMPC_STATES];
    real R[GPMPC_INPUTS * GPMPC_INPUTS];
    real D[GPMPC_INPUTS * GPMPC_INPUTS];
    int k;
    if (!GPMPC_FEEDBACK) {
        fill(&problem->gains[0][0][0], 0, H * m * n);
        return;
    }
    copy(state_weights, Q, n * n);
    copy(input_weights, R, m * m);
    copy(terminal_weight, P, n * n);
#if GPMPC_OUTPUTS
    for (k = 0; k < n; k++) {
        add_scaled(1, problem->Z[0][k], Q + k * n, n);
        add_scaled(1, problem->Z[H - 1][k], P + k * n, n);
    }
    for (k = 0; k < m; k++)
        add_scaled(1, problem->Z[0][n + k] + n, R + k * m, m);
#endif
    for (k = H - 1; k >= 0; k--)
        riccati(&problem->A[stage_of(k)][0][0], &problem->B[stage_of(k)][0][0], Q, R, n,
                P, &problem->gains[k][0][0], D);
}
#endif

#if GPMPC_TUBES || GPMPC_FILTERS
/* after <- A before A' + V, symmetric; ``after`` may be ``before`` */
static void move_covariance(const real *A, const real *V, const real *before,
                            real *after)
{
    real spread[GPMPC_STATES * GPMPC_STATES];
    int i, j;
    product(A, before, n, n, n, spread);
    for (i = 0; i < n; i++)
        for (j = 0; j <= i; j++) {
            real total = (V[i * n + j] + V[j * n + i]) / 2;
            total += dot(spread + i * n, A + j * n, n);
            after[i * n + j] = total;
            after[j * n + i] = total;
        }
}
#endif

#if GPMPC_TUBES
/* Sigma_{k+1} = (A - B K) Sigma_k (A - B K)' + V */
static void predict_covariances(gpmpc_problem *problem, const real *start)
{
    real closed[GPMPC_STATES * GPMPC_STATES];
    int k, i, j, l;
    copy(start, &problem->covariances[0][0][0], n * n);
    for (k = 0; k < H; k++) {
        int stage = stage_of(k);
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++) {
                closed[i * n + j] = problem->A[stage][i][j];
                for (l = 0; l < m; l++)
                    closed[i * n + j] -=
                        problem->B[stage][i][l] * problem->gains[k][l][j];
            }
        move_covariance(closed, &problem->V[stage][0][0],
                        &problem->covariances[k][0][0],
                        &problem->covariances[k + 1][0][0]);
    }
}
#endif

/* ------------------------------------------------------------------------------------
   The rows of the states' constraints.
   --------------------------------------------------------------------------------- */

/* Gradient of row e at stage k by s_{k+1}; that by u_k is zero where none is smooth. */
#if GPMPC_SMOOTH
#define ROW_BY_STATE(problem, k, e) ((problem)->E[k][e])
#else
#define ROW_BY_STATE(problem, k, e) \
    ((void)(problem), (void)(k), row_gradients + (e) * n)
#endif

/* E s_{k+1} + D u_k */
static real row_value(const gpmpc_problem *problem, int k, int e, const real *s,
                      const real *u)
{
    real value = dot(ROW_BY_STATE(problem, k, e), s, n);
#if GPMPC_SMOOTH
    value += dot(problem->D[k][e], u, m);
#else
    (void)problem;
    (void)u;
#endif
    return value;
}

/* By how much E s_{k+1} + D u_k misses a bound of its row; negative inside. */
static real row_miss(const gpmpc_problem *problem, int k, int e, const real *s,
                     const real *u)
{
    real value = row_value(problem, k, e, s, u);
    return larger(value - problem->row_upper[k][e], problem->row_lower[k][e] - value);
}

#if GPMPC_SMOOTH
/* Writes the smooth rows, linearised at the plan. Returns whether they are finite. */
static int write_smooth_rows(gpmpc_problem *problem, const gpmpc_reference *reference)
{
    real h[GPMPC_ROWS];
    int finite = 1;
    int k, e;
    for (k = 0; k < H; k++) {
        copy(row_gradients, &problem->E[k][0][0], r * n);
        fill(&problem->D[k][0][0], 0, r * m);
        constraints(problem->states[k + 1], problem->inputs[k],
                    reference->parameters[k], h, &problem->E[k][0][0],
                    &problem->D[k][0][0]);
        for (e = 0; e < r; e++) {
            if (!row_is_smooth[e])
                continue;
            finite = finite && is_finite(h[e]) && all_finite(problem->E[k][e], n)
                     && all_finite(problem->D[k][e], m);
            problem->row_upper[k][e] += dot(problem->E[k][e], problem->states[k + 1], n)
                                        - h[e]
                                        + dot(problem->D[k][e], problem->inputs[k], m);
        }
    }
    return finite;
}
#endif

#if GPMPC_TUBES
/* Moves the bounds of the rows inwards by kappa sqrt(F Sigma F'). */
static void tighten_rows(gpmpc_problem *problem)
{
    int k, e, i;
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++) {
            const real *F = ROW_BY_STATE(problem, k, e);
            real variance = 0;
            real margin;
            for (i = 0; i < n; i++)
                if (F[i] != 0)
                    variance += F[i] * dot(problem->covariances[k + 1][i], F, n);
            margin = row_kappas[e] * SQRT(larger(variance, 0));
            problem->row_lower[k][e] += margin;
            problem->row_upper[k][e] -= margin;
        }
}
#endif

/* Writes the rows at the plan, with their prices. Returns whether all functions are
   finite. */
static int write_rows(gpmpc_problem *problem, const gpmpc_reference *reference)
{
    int finite = 1;
    int k;
    for (k = 0; k < H; k++) {
        copy(row_lower + k * r, problem->row_lower[k], r);
        copy(row_upper + k * r, problem->row_upper[k], r);
    }
    copy(row_prices, problem->prices, r);
#if GPMPC_SMOOTH
    finite = write_smooth_rows(problem, reference);
#else
    (void)reference;
#endif
#if GPMPC_TUBES
    tighten_rows(problem);
#endif
    return finite;
}

#if GPMPC_ROLLS_OUT || !GPMPC_IS_FLOAT
/* By how much the plan misses a bound of states, inputs or increments, at most. */
static real largest_violation(const gpmpc_problem *problem)
{
    real largest = 0;
    int k, e, i;
    for (k = 0; k < H; k++) {
        const real *u = problem->inputs[k];
        for (e = 0; e < r; e++)
            largest =
                larger(largest, row_miss(problem, k, e, problem->states[k + 1], u));
        for (i = 0; i < m; i++) {
            largest = larger(largest, larger(u[i] - input_upper[k * m + i],
                                             input_lower[k * m + i] - u[i]));
            if (GPMPC_HAS_RATES) {
                real rate = u[i] - (k > 0 ? problem->inputs[k - 1][i]
                                          : problem->previous_input[i]);
                largest = larger(largest, larger(rate - rate_upper[k * m + i],
                                                 rate_lower[k * m + i] - rate));
            }
        }
    }
    return largest;
}
#endif

static int is_hard(int e) { return row_prices[e] > LARGEST; }

/* Whether the plan misses no hard row of the states by more than a limit. */
static int keeps_hard_rows(const gpmpc_problem *problem, real limit)
{
    int k, e;
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++) {
            real miss =
                row_miss(problem, k, e, problem->states[k + 1], problem->inputs[k]);
            if (is_hard(e) && !(miss <= limit))
                return 0;
        }
    return 1;
}

/* ------------------------------------------------------------------------------------
   Condensing: the states are eliminated (gpmpc/mpc/_condense.py).
   --------------------------------------------------------------------------------- */

/* Writes the input's part of the Hessian: 2 R, and its coupling for increments. */
static void write_input_hessian(gpmpc_program *program)
{
    int k, i, j;
    fill(&program->P[0][0], 0, N * N);
    for (k = 0; k < H; k++)
        for (i = 0; i < m; i++)
            for (j = 0; j < m; j++) {
                real weight = input_weight(k)[i * m + j];
                program->P[k * m + i][k * m + j] = 2 * weight;
                if (GPMPC_PENALIZED != INCREMENTS)
                    continue;
                if (k < H - 1)
                    program->P[k * m + i][k * m + j] +=
                        2 * input_weight(k + 1)[i * m + j];
                if (k > 0)
                    program->P[k * m + i][(k - 1) * m + j] = -2 * weight;
            }
}

/* Writes 2 B_k' M_{k+1} for the cost to go without input,
   M_H = W_H, M_k = W_k + A_k' M_{k+1} A_k. */
static void write_costs_to_go(gpmpc_problem *problem, gpmpc_program *program)
{
    real M[GPMPC_STATES * GPMPC_STATES];
    real MA[GPMPC_STATES * GPMPC_STATES];
    int k, i, j, l;
    (void)program;
    fill(M, 0, n * n);
    for (k = H - 1; k >= 0; k--) {
        const real *A = &problem->A[stage_of(k)][0][0];
        add_scaled(1, weight_of_stage(k), M, n * n);
#if GPMPC_OUTPUTS
        for (i = 0; i < n; i++)
            add_scaled(1, problem->Z[k][i], M + i * n, n);
#endif
        for (j = 0; j < m; j++)
            for (i = 0; i < n; i++) {
                real total = 0;
                for (l = 0; l < n; l++)
                    total += M[i * n + l] * problem->B[stage_of(k)][l][j];
                problem->BM[k][j][i] = 2 * total;
            }
#if GPMPC_OUTPUTS
        for (i = 0; i < m; i++) {
            const real *Z = problem->Z[k][n + i];
            for (j = 0; j < m; j++) {
                real total = Z[n + j];
                for (l = 0; l < n; l++)
                    total += problem->B[stage_of(k)][l][i] * problem->Z[k][l][n + j];
                program->P[k * m + i][k * m + j] += 2 * total;
            }
            add_scaled(2, Z, problem->BM[k][i], n);
        }
#endif
        product(M, A, n, n, n, MA);
        fill(M, 0, n * n);
        add_transposed_product(A, MA, n, n, n, M);
    }
}

/* Adds 2 Gamma'W Gamma to P, and writes E Gamma + D to G:
   Gamma_{k+1} = [A_k Gamma_k, B_k] are the derivatives of s_{k+1} by the inputs. */
static void add_states(gpmpc_problem *problem, gpmpc_program *program)
{
    int k, i, j, e;
    int now = 0;
    for (k = 0; k < H; k++) {
        int before = k * m;
        int width = before + m;
        int stage = stage_of(k);
        for (i = 0; i < n; i++) {
            real *next = problem->gamma[1 - now][i];
            fill(next, 0, before);
            add_combination(1, problem->A[stage][i], 1, problem->gamma[now], n, next,
                            before);
            copy(problem->B[stage][i], next + before, m);
        }
        now = 1 - now;
        for (i = 0; i < m; i++)
            add_combination(1, problem->BM[k][i], 1, problem->gamma[now], n,
                            program->P[before + i], width);
        for (e = 0; e < r; e++) {
            real *row = program->G[GPMPC_RATE_ROWS + k * r + e];
            fill(row, 0, N);
            add_combination(1, ROW_BY_STATE(problem, k, e), 1, problem->gamma[now], n,
                            row, width);
#if GPMPC_SMOOTH
            add_scaled(1, problem->D[k][e], row + before, m);
#endif
        }
    }
    for (i = 0; i < N; i++)
        for (j = 0; j < i; j++)
            program->P[j][i] = program->P[i][j];
}

/* Writes the bounds of constraint p less its value at v = 0; in float with what these
   round off. */
static void write_bound(gpmpc_program *program, int p, real low, real high, real value)
{
    Pair lower = pair_of(low, 0);
    Pair upper = pair_of(high, 0);
    add(&lower, -value);
    add(&upper, -value);
    program->lower[p] = lower.high;
    program->upper[p] = upper.high;
    program->lower_low[p] = GPMPC_IS_FLOAT && is_finite(low) ? lower.low : 0;
    program->upper_low[p] = GPMPC_IS_FLOAT && is_finite(high) ? upper.low : 0;
}

/* Writes the bounds of inputs, increments and rows, of which inputs and states are
   those at v = 0; the first ``unbounded`` constraints have none. */
static void write_bounds(const gpmpc_problem *problem, const real *inputs,
                         const real *states, int unbounded, gpmpc_program *program)
{
    int k, i, e;
    int first_rate = unbounded + N;
    int first_row = first_rate + GPMPC_RATE_ROWS;
    for (i = 0; i < unbounded; i++)
        write_bound(program, i, -INFINITY, INFINITY, 0);
    for (k = 0; k < H; k++) {
        const real *u = inputs + k * m;
        for (i = 0; i < m; i++) {
            write_bound(program, unbounded + k * m + i, input_lower[k * m + i],
                        input_upper[k * m + i], u[i]);
            if (GPMPC_HAS_RATES) {
                real last = k > 0 ? inputs[(k - 1) * m + i]
                                  : problem->previous_input[i];
                write_bound(program, first_rate + k * m + i, rate_lower[k * m + i],
                            rate_upper[k * m + i], u[i] - last);
            }
        }
        for (e = 0; e < r; e++) {
            real value = row_value(problem, k, e, states + (k + 1) * n, u);
            write_bound(program, first_row + k * r + e, problem->row_lower[k][e],
                        problem->row_upper[k][e], value);
        }
    }
}

/* The input from which that of stage k is weighed. */
static real centre_of_input(const gpmpc_problem *problem, int k, int i)
{
    if (GPMPC_PENALIZED == DEVIATIONS)
        return problem->target_inputs[k][i];
    if (GPMPC_PENALIZED == INCREMENTS && k == 0)
        return problem->previous_input[i];
    return 0;
}

/* Writes s_0 .. s_H without input. */
static void write_free_states(const gpmpc_problem *problem, real *states)
{
    int k, i;
    copy(problem->states[0], states, n);
    for (k = 0; k < H; k++)
        for (i = 0; i < n; i++)
            states[(k + 1) * n + i] =
                problem->c[stage_of(k)][i]
                + dot(problem->A[stage_of(k)][i], states + k * n, n);
}

/* Writes q by the adjoint recursion, and the bounds. */
static void write_gradient(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_program *program = &controller->program;
    real free_states[(GPMPC_HORIZON + 1) * GPMPC_STATES]; /* without input */
    real no_inputs[GPMPC_SIZE];
    real error[GPMPC_STATES];
    real gradient[GPMPC_STATES];
    real costate[GPMPC_STATES]; /* A_k' times the gradient by s_{k+1} */
    int k, i, j;
    write_free_states(problem, free_states);
    fill(program->q, 0, N);
    fill(costate, 0, n);
    for (k = H - 1; k >= 0; k--) {
        const real *state = free_states + (k + 1) * n;
        real *q = program->q + k * m;
        for (j = 0; j < m; j++) {
            real centre = centre_of_input(problem, k, j);
            for (i = 0; i < m; i++)
                q[i] -= 2 * input_weight(k)[i * m + j] * centre;
        }
        for (i = 0; i < n; i++)
            error[i] = state[i] - problem->targets[k + 1][i];
        multiply(weight_of_stage(k), error, n, n, gradient);
        for (i = 0; i < n; i++)
            gradient[i] = 2 * gradient[i] + costate[i];
#if GPMPC_OUTPUTS
        for (i = 0; i < n + m; i++) {
            const real *Z = problem->Z[k][i];
            real slope = 2 * (dot(Z, state, n) + Z[n + m]);
            if (i < n)
                gradient[i] += slope;
            else
                q[i - n] += slope;
        }
#endif
        fill(costate, 0, n);
        for (i = 0; i < n; i++) {
            add_scaled(gradient[i], problem->A[stage_of(k)][i], costate, n);
            add_scaled(gradient[i], problem->B[stage_of(k)][i], q, m);
        }
    }
    fill(no_inputs, 0, N);
    write_bounds(problem, no_inputs, free_states, 0, program);
}

/* Writes one stage of [s_k - r_k; u_{k-1}; 1] and its weight, of ``size`` entries. */
static void write_augmented(const gpmpc_problem *problem, int k, int size, real *A,
                            real *B)
{
    const real no_target[GPMPC_STATES] = {0};
    const real *origin = k == 0 ? no_target : problem->targets[k]; /* s_0 has none */
    int stage = stage_of(k);
    int e = size - 1;
    int i;
    fill(A, 0, size * size);
    fill(B, 0, size * m);
    for (i = 0; i < n; i++) {
        real shift = problem->c[stage][i] - problem->targets[k + 1][i];
        copy(problem->A[stage][i], A + i * size, n);
        copy(problem->B[stage][i], B + i * m, m);
        shift += dot(problem->A[stage][i], origin, n);
        if (GPMPC_PENALIZED == DEVIATIONS)
            shift += dot(problem->B[stage][i], problem->target_inputs[k], m);
        A[i * size + e] = shift;
    }
    for (i = 0; i < e - n; i++) {
        B[(n + i) * m + i] = 1;
        if (GPMPC_PENALIZED == DEVIATIONS)
            A[(n + i) * size + e] = problem->target_inputs[k][i];
    }
    A[e * size + e] = 1;
    if (GPMPC_PENALIZED == INCREMENTS)
        for (i = 0; i < size; i++)
            add_scaled(1, B + i * m, A + i * size + n, m);
}

/* Writes the weight W (size, size) of the augmented state after stage k. */
static void write_augmented_weight(const gpmpc_problem *problem, int k, int size,
                                   real *W)
{
    int i;
    fill(W, 0, size * size);
    for (i = 0; i < n; i++)
        copy(weight_of_stage(k) + i * n, W + i * size, n);
    (void)problem;
#if GPMPC_OUTPUTS
    for (i = 0; i < n + m; i++) {
        const real *Z = problem->Z[k][i];
        real constant = Z[n + m] + dot(Z, problem->targets[k + 1], n);
        add_scaled(1, Z, W + i * size, n + m);
        W[i * size + size - 1] += constant;
        W[(size - 1) * size + i] += constant;
    }
#endif
}

/* Writes the feedback that is optimal without bounds,
   u_k = F_k [s_k; u_{k-1}; 1], and half the Hessian of the cost in what is added. */
static void write_feedback(gpmpc_problem *problem)
{
    enum {
        WITH_INPUT = GPMPC_PENALIZED == INCREMENTS || GPMPC_OUTPUTS,
        size = GPMPC_STATES + (WITH_INPUT ? GPMPC_INPUTS : 0) + 1
    };
    real A[size * size];
    real B[size * GPMPC_INPUTS];
    real P[size * size];
    real W[size * size];
    real K[GPMPC_INPUTS * size];
    int k, i;
    write_augmented_weight(problem, H - 1, size, P);
    for (k = H - 1; k >= 0; k--) {
        write_augmented(problem, k, size, A, B);
        if (k > 0)
            write_augmented_weight(problem, k - 1, size, W);
        riccati(A, B, k > 0 ? W : 0, input_weight(k), size, P, K,
                &problem->hessians[k][0][0]);
        for (i = 0; i < m; i++) {
            real *F = problem->feedback[k][i];
            int j;
            fill(F, 0, GPMPC_AUGMENTED);
            for (j = 0; j < size - 1; j++)
                F[j] = -K[i * size + j];
            if (GPMPC_PENALIZED == INCREMENTS)
                F[n + i] += 1;
            F[n + m] = -K[i * size + size - 1];
            if (GPMPC_PENALIZED == DEVIATIONS)
                F[n + m] += problem->target_inputs[k][i];
            if (k > 0)
                F[n + m] += dot(K + i * size, problem->targets[k], n);
        }
    }
}

/* Writes the inputs and states of unknowns v:
   u_k = F_k [s_k; u_{k-1}; 1] + v_k (or v_k), s_{k+1} = A_k s_k + B_k u_k + c_k */
static void expand(const gpmpc_problem *problem, const real *unknowns, real *inputs,
                   real *states)
{
    int k, i;
    copy(problem->states[0], states, n);
    for (k = 0; k < H; k++) {
        const real *s = states + k * n;
        real *u = inputs + k * m;
        for (i = 0; i < m; i++) {
            u[i] = unknowns[k * m + i];
            if (problem->has_feedback) {
                const real *F = problem->feedback[k][i];
                const real *last = k > 0 ? inputs + (k - 1) * m
                                         : problem->previous_input;
                u[i] += F[n + m] + dot(F, s, n) + dot(F + n, last, m);
            }
        }
        for (i = 0; i < n; i++)
            states[(k + 1) * n + i] = problem->c[stage_of(k)][i]
                                      + dot(problem->A[stage_of(k)][i], s, n)
                                      + dot(problem->B[stage_of(k)][i], u, m);
    }
}

/* Writes the derivatives by v of s_{k+1} and u_k, ``next``, from those of s_k and
   u_{k-1}, ``response``. */
static void write_response(const gpmpc_problem *problem, int k,
                           real (*response)[GPMPC_SIZE], real (*next)[GPMPC_SIZE])
{
    int here = k * m;
    int width = here + m;
    int i;
    for (i = 0; i < m; i++) {
        fill(next[n + i], 0, N);
        add_combination(1, problem->feedback[k][i], 1, response, n + m, next[n + i],
                        here);
        next[n + i][here + i] = 1;
    }
    for (i = 0; i < n; i++) {
        fill(next[i], 0, N);
        add_combination(1, problem->A[stage_of(k)][i], 1, response, n, next[i], width);
        add_combination(1, problem->B[stage_of(k)][i], 1, next + n, m, next[i], width);
    }
}

/* Writes the program in feedback coordinates: P is block diagonal, q zero, and the
   bounds of inputs are rows. */
static void condense_with_feedback(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_program *program = &controller->program;
    real inputs[GPMPC_SIZE];
    real states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    int k, i, j, e;
    int now = 0;
    write_feedback(problem);
    problem->has_feedback = 1;
    program->rows = GPMPC_G_ROWS;
    fill(&program->P[0][0], 0, N * N);
    fill(&program->G[0][0], 0, GPMPC_G_ROWS * N);
    fill(program->q, 0, N);
    fill(&problem->gamma[0][0][0], 0, 2 * (n + m) * N);
    for (k = 0; k < H; k++) {
        real(*response)[GPMPC_SIZE] = problem->gamma[now];
        real(*next)[GPMPC_SIZE] = problem->gamma[1 - now];
        int here = k * m;
        int width = here + m;
        write_response(problem, k, response, next);
        for (i = 0; i < m; i++) {
            for (j = 0; j < m; j++)
                program->P[here + i][here + j] = 2 * problem->hessians[k][i][j];
            copy(next[n + i], program->G[here + i], width);
            if (GPMPC_HAS_RATES)
                for (j = 0; j < width; j++)
                    program->G[N + here + i][j] = next[n + i][j] - response[n + i][j];
        }
        for (e = 0; e < r; e++) {
            real *row = program->G[N + GPMPC_RATE_ROWS + k * r + e];
            add_combination(1, ROW_BY_STATE(problem, k, e), 1, next, n, row, width);
#if GPMPC_SMOOTH
            add_combination(1, problem->D[k][e], 1, next + n, m, row, width);
#endif
        }
        now = 1 - now;
    }
    expand(problem, program->q, inputs, states);
    write_bounds(problem, inputs, states, N, program);
}

/* Makes the quadratic program, in the coordinates that suit it: where A grows over the
   horizon, P in the inputs spans more digits than a number has. Roll-outs follow the
   program's feedback only where doubles need these coordinates, too. */
static void condense(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_program *program = &controller->program;
    real growth = 0;
    int i, k;
    problem->has_feedback = 0;
    program->rows = GPMPC_RATE_ROWS + GPMPC_STATE_ROWS;
    write_input_hessian(program);
    fill(&program->G[0][0], 0, GPMPC_RATE_ROWS * N);
    for (i = 0; i < GPMPC_RATE_ROWS; i++) { /* u_k - u_{k-1} */
        program->G[i][i] = 1;
        if (i >= m)
            program->G[i][i - m] = -1;
    }
    write_costs_to_go(problem, program);
    add_states(problem, program);
    for (k = 0; k < H; k++)
        for (i = 0; i < m; i++) {
            int here = k * m + i;
            int last = N - m + i;
            growth += program->P[here][here] / program->P[last][last];
        }
    problem->is_unstable = !(growth <= UNSTABLE_GROWTH);
    if (growth <= LARGEST_GROWTH)
        write_gradient(controller);
    else
        condense_with_feedback(controller);
}

/*{exact}*/

/*{qp}*/

/* ------------------------------------------------------------------------------------
   The decision.
   --------------------------------------------------------------------------------- */

#if GPMPC_ROLLS_OUT || GPMPC_ELASTIC
/* Replaces a plan (x', u') by the one that the dynamics obey on the way along it,
   u = u' + F (x - x') within its bounds. */
static void follow(gpmpc_controller *controller, real *states, real *inputs)
{
    gpmpc_problem *problem = &controller->problem;
    real target[GPMPC_STATES];
    int k, i, j;
    copy(states, target, n);
    for (k = 0; k < H; k++) {
        const real *state = states + k * n;
        real *next = states + (k + 1) * n;
        for (i = 0; i < m; i++) {
            real last =
                k > 0 ? inputs[(k - 1) * m + i] : problem->previous_input[i];
            real u = inputs[k * m + i];
            for (j = 0; j < n; j++) {
                real gain = problem->is_unstable ? problem->feedback[k][i][j]
                                                 : -problem->gains[k][i][j];
                u += gain * (state[j] - target[j]);
            }
            inputs[k * m + i] = within_box(within_rates(u, last, k, i), k, i);
        }
        copy(next, target, n);
        model(state, inputs + k * m, &problem->work, next, 0, 0);
        for (i = 0; i < n && GPMPC_ESTIMATES; i++)
            next[i] += controller->estimate[i];
    }
}
#endif

/* Writes by how much a plan misses its rows (H, r), zero inside. */
static void write_misses_of_plan(const gpmpc_problem *problem, const real *states,
                                 const real *inputs, real *misses)
{
    int k, e;
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++)
            misses[k * r + e] = larger(
                0, row_miss(problem, k, e, states + (k + 1) * n, inputs + k * m));
}

/* The same for the plan of a solution, in float in doubled digits. */
static void write_misses(const gpmpc_problem *problem, const gpmpc_solution *solution,
                         real *misses)
{
#if GPMPC_IS_FLOAT
    Rollout plan;
    int k, e;
    roll_out(problem, solution->x, solution->x_low, &plan);
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++) {
            Pair value = exact_row(problem, &plan, k, e);
            real above = (value.high - problem->row_upper[k][e]) + value.low;
            real below = (problem->row_lower[k][e] - value.high) - value.low;
            misses[k * r + e] = larger(0, larger(above, below));
        }
#else
    real inputs[GPMPC_SIZE];
    real states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    expand(problem, solution->x, inputs, states);
    write_misses_of_plan(problem, states, inputs, misses);
#endif
}

#if GPMPC_ELASTIC
/* What a plan costs: its stages, summed. */
static real cost_of_plan(const gpmpc_problem *problem, const real *states,
                         const real *inputs)
{
    real total = 0;
    int k, i, j;
    for (k = 0; k < H; k++) {
        real error[GPMPC_STATES];
        real v[GPMPC_INPUTS];
        for (i = 0; i < n; i++)
            error[i] = states[(k + 1) * n + i] - problem->targets[k + 1][i];
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++)
                total += error[i] * weight_of_stage(k)[i * n + j] * error[j];
        for (i = 0; i < m; i++) {
            v[i] = inputs[k * m + i];
            if (GPMPC_PENALIZED == DEVIATIONS)
                v[i] -= problem->target_inputs[k][i];
            else if (GPMPC_PENALIZED == INCREMENTS)
                v[i] -= k > 0 ? inputs[(k - 1) * m + i] : problem->previous_input[i];
        }
        for (i = 0; i < m; i++)
            for (j = 0; j < m; j++)
                total += v[i] * input_weight(k)[i * m + j] * v[j];
#if GPMPC_OUTPUTS
        {
            real z[GPMPC_AUGMENTED];
            copy(states + (k + 1) * n, z, n);
            copy(inputs + k * m, z + n, m);
            z[n + m] = 1;
            for (i = 0; i <= n + m; i++)
                total += z[i] * dot(problem->Z[k][i], z, n + m + 1);
        }
#endif
    }
    return total;
}

/* The elastic rows that a program misses under their exact prices. */
typedef struct {
    int count;
    int gives_way[r];
    real lengths[r];    /* what each rises per unit of distance */
    int are_kept_again; /* early on the horizon rather than late */
} elastic_rows;

/* The square of what row e rises at stage k per unit of distance. */
static real squared_length(const gpmpc_problem *problem, int k, int e)
{
    const real *by_state = ROW_BY_STATE(problem, k, e);
    real square = dot(by_state, by_state, n);
#if GPMPC_SMOOTH
    square += dot(problem->D[k][e], problem->D[k][e], m);
#endif
    return square > 0 ? square : 1;
}

/* Returns the length of a row: the mean over the stages, by what is missed there,
   exactly the first where all stages have the same. */
static real row_length(const gpmpc_problem *problem, const real *misses, int e)
{
    real first = SQRT(squared_length(problem, 0, e));
    real beyond_first = 0;
    real missed = 0;
    int k;
    for (k = 0; k < H; k++) {
        real length = SQRT(squared_length(problem, k, e));
        beyond_first += misses[k * r + e] * (length - first);
        missed += misses[k * r + e];
    }
    return first + beyond_first / missed;
}

/* Whether rows that give way are missed early on the horizon rather than late. */
static int are_kept_again(const real *misses, const elastic_rows *rows)
{
    real moment = 0;
    real size = 0; /* of its terms */
    int k, e;
    for (k = 0; k < H; k++) {
        real distance = 0;
        real term;
        for (e = 0; e < r; e++)
            if (rows->gives_way[e])
                distance += misses[k * r + e] / rows->lengths[e];
        term = (k - REAL(0.5) * (H - 1)) * distance;
        moment += term;
        size += absolute(term);
    }
    return moment <= GPMPC_NO_MOMENT * size;
}

/* Finds the elastic rows that are missed (H, r), which give way. */
static void find_elastic_rows(const gpmpc_problem *problem, const real *misses,
                              elastic_rows *rows)
{
    int k, e;
    rows->count = 0;
    for (e = 0; e < r; e++) {
        rows->gives_way[e] = 0;
        rows->lengths[e] = 1;
        for (k = 0; k < H && row_is_elastic[e]; k++)
            if (misses[k * r + e] / SQRT(squared_length(problem, k, e)) > KEPT)
                rows->gives_way[e] = 1;
        if (rows->gives_way[e])
            rows->lengths[e] = row_length(problem, misses, e);
        rows->count += rows->gives_way[e];
    }
    rows->are_kept_again = are_kept_again(misses, rows);
}

/* What elastic rows that cannot be kept may cost; prices are of distances. */
typedef struct {
    real safe_price;            /* under which no plan outweighs the cost */
    real lowest_trial_price;    /* of those that are tried for a plan that goes on */
    real exact_price;           /* the highest of the rows */
    real affordable_extra_cost; /* of such a plan, beside that without them */
} elastic_limits;

/* What it costs to be beside the reference by a miss of row e at stage k. */
static real moving_cost(const gpmpc_problem *problem, int k, int e, real miss)
{
    const real *g = ROW_BY_STATE(problem, k, e);
    const real *Q = running_weight(k);
    real square = dot(g, g, n);
    real move = miss / squared_length(problem, k, e); /* times the gradient */
    real weight = 0;
    real largest = 0;
    int i;
    for (i = 0; i < n; i++) {
        weight += g[i] * dot(Q + i * n, g, n);
        largest = larger(largest, Q[i * n + i]);
    }
    if (!(largest > 0))
        largest = GPMPC_LARGEST_WEIGHT;
    /* counts where the cost does not weigh the direction */
    if (!(weight > GPMPC_NO_WEIGHT * largest * square))
        weight = largest * square;
#if GPMPC_SMOOTH
    weight += largest * dot(problem->D[k][e], problem->D[k][e], m);
#endif
    return weight * move * move;
}

/* Returns a price of few digits: the exact one over quarters of powers of two. */
static real rounded_price(real price, real exact_price)
{
    const real log_2 = REAL(0.6931471805599453);
    real quarters = FLOOR(4 * LOG(price / exact_price) / log_2 + REAL(0.5));
    return exact_price * POW(2, quarters / 4);
}

/* Returns the limits of the price of elastic rows (gpmpc/mpc/_elastic.py), from the
   cost J0 and the misses (H, r) of the plan without them. */
static elastic_limits limits_of_price(const gpmpc_problem *problem, const real *misses,
                                      const elastic_rows *rows,
                                      real programmed_free_cost, real guess_cost)
{
    elastic_limits limits;
    real cost = smaller(larger(programmed_free_cost, guess_cost),
                        2 * programmed_free_cost);
    real distance = 0;
    real moving = 0;
    real lowest_price;
    int k, e;
    limits.exact_price = 0;
    for (e = 0; e < r; e++)
        if (rows->gives_way[e])
            limits.exact_price =
                larger(limits.exact_price, row_prices[e] * rows->lengths[e]);
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++)
            if (rows->gives_way[e] && misses[k * r + e] > 0) {
                moving += moving_cost(problem, k, e, misses[k * r + e]);
                distance += misses[k * r + e] / rows->lengths[e];
            }
    lowest_price = GPMPC_NO_PRICE * limits.exact_price;
    limits.safe_price =
        GPMPC_WORTH * (cost + moving) / larger(distance, REAL(1e-12));
    limits.safe_price = rounded_price(larger(limits.safe_price, lowest_price),
                                      limits.exact_price);
    if (rows->are_kept_again) {
        limits.lowest_trial_price = limits.safe_price;
        limits.affordable_extra_cost = GPMPC_SHARE * (programmed_free_cost + moving);
    } else {
        limits.lowest_trial_price =
            larger(GPMPC_LOWEST * limits.safe_price, lowest_price);
        limits.affordable_extra_cost = GPMPC_SHARE * programmed_free_cost;
    }
    return limits;
}

/* Sets the prices of rows that give way by one of distances, the exact ones at most. */
static void lower_prices(gpmpc_problem *problem, const elastic_rows *rows, real price)
{
    int e;
    for (e = 0; e < r; e++)
        if (rows->gives_way[e])
            problem->prices[e] = smaller(price / rows->lengths[e], row_prices[e]);
}

/* Solves the program where rows that give way do not count: they keep their place. */
static void solve_free(gpmpc_controller *controller, const elastic_rows *rows)
{
    gpmpc_problem *problem = &controller->problem;
    int e;
    for (e = 0; e < r; e++)
        if (rows->gives_way[e])
            problem->prices[e] = GPMPC_NO_PRICE * row_prices[e];
    solve(problem, &controller->program, &controller->candidate,
          &controller->trial_solution);
}

static void restore_exact_prices(gpmpc_problem *problem)
{
    copy(row_prices, problem->prices, r);
}

/* What it costs to roll the model out along the plan of a solution: infinite where that
   overflows. */
static real cost_when_followed(gpmpc_controller *controller,
                               const gpmpc_solution *solution)
{
    gpmpc_problem *problem = &controller->problem;
    real inputs[GPMPC_SIZE];
    real states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    expand(problem, solution->x, inputs, states);
    follow(controller, states, inputs);
    if (!all_finite(states, (H + 1) * n))
        return INFINITY;
    return cost_of_plan(problem, states, inputs);
}

/* Solves the program once more, under a lower price of the rows that give way. Where
   that is not solved, the solution under the exact ones stays. */
static void solve_cheaper(gpmpc_controller *controller, const elastic_rows *rows,
                          real price)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_solution *solution = &controller->candidate;
    gpmpc_solution *cheaper = &controller->trial_solution;
    lower_prices(problem, rows, price);
    solve(problem, &controller->program, solution, cheaper);
    if (cheaper->status == GPMPC_SOLVED)
        *solution = *cheaper;
    else
        restore_exact_prices(problem);
}

/* Solves the program for the highest price of elastic rows whose plan is affordable:
   the exact one, or one of a few between the lowest and that; the lowest where none is.
 */
static void solve_at_highest_price(gpmpc_controller *controller,
                                   const elastic_rows *rows, elastic_limits limits,
                                   real affordable_cost)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_solution *solution = &controller->candidate;
    gpmpc_solution *trial = &controller->trial_solution;
    real affordable_price = limits.lowest_trial_price;
    real unaffordable_price = limits.exact_price;
    int is_affordable = 0;
    int i;
    if (cost_when_followed(controller, solution) <= affordable_cost) {
        restore_exact_prices(problem);
        return;
    }
    for (i = 0; i < GPMPC_TRIALS; i++) {
        real price = SQRT(affordable_price * unaffordable_price);
        lower_prices(problem, rows, price);
        solve(problem, &controller->program, solution, trial);
        if (trial->status == GPMPC_SOLVED
            && cost_when_followed(controller, trial) <= affordable_cost) {
            is_affordable = 1;
            affordable_price = price;
            *solution = *trial;
        } else {
            unaffordable_price = price;
        }
    }
    if (is_affordable)
        lower_prices(problem, rows, affordable_price);
    else
        solve_cheaper(controller, rows, affordable_price);
}

/* Replaces a solution that misses an elastic row by the one under the price that the
   row is worth. Every program that is tried leaves its solution in the same place: that
   of free rows is read before the next one. */
static void solve_elastic(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_solution *solution = &controller->candidate;
    gpmpc_solution *free_solution = &controller->trial_solution;
    elastic_rows rows;
    elastic_limits limits;
    real misses[GPMPC_STATE_ROWS];
    real inputs[GPMPC_SIZE];
    real states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    real guess_cost;
    real affordable_cost = INFINITY;
    if (solution->status != GPMPC_SOLVED)
        return;
    write_misses(problem, solution, misses);
    find_elastic_rows(problem, misses, &rows);
    if (rows.count == 0)
        return;
    guess_cost = cost_of_plan(problem, &problem->states[0][0], &problem->inputs[0][0]);
    solve_free(controller, &rows);
    if (free_solution->status != GPMPC_SOLVED) {
        restore_exact_prices(problem);
        return;
    }
    expand(problem, free_solution->x, inputs, states);
    write_misses(problem, free_solution, misses);
    limits = limits_of_price(problem, misses, &rows,
                             cost_of_plan(problem, states, inputs), guess_cost);
    if (limits.lowest_trial_price >= limits.exact_price) {
        restore_exact_prices(problem);
        return;
    }
    if (!problem->is_unstable)
        write_gains(problem);
    if (controller->has_plan)
        affordable_cost = cost_when_followed(controller, free_solution)
                          + limits.affordable_extra_cost;
    if (is_finite(affordable_cost))
        solve_at_highest_price(controller, &rows, limits, affordable_cost);
    else
        solve_cheaper(controller, &rows, limits.safe_price);
}
#endif

/* 1/2 x'Px + q'x and the price of violated soft rows. */
static real objective(const gpmpc_program *program, const real *x)
{
    real total = 0;
    int i, p;
    for (i = 0; i < N; i++)
        total += x[i] * (dot(program->P[i], x, N) / 2 + program->q[i]);
    for (p = N; p < N + program->rows; p++) {
        real value = dot(program->G[p - N], x, N);
        real beyond = larger(value - program->upper[p], program->lower[p] - value);
        if (program->cap[p] < LARGEST && beyond > 0)
            total += program->cap[p] * beyond;
    }
    return total;
}

/* The largest violation of a hard constraint of the program. */
static real hard_violation(const gpmpc_program *program, const real *x)
{
    real largest = 0;
    int p;
    for (p = 0; p < N + program->rows; p++) {
        real value = p < N ? x[p] : dot(program->G[p - N], x, N);
        if (program->cap[p] > LARGEST)
            largest = larger(largest, larger(value - program->upper[p],
                                             program->lower[p] - value));
    }
    return largest;
}

/* Whether a solution leads to a plan that is no worse than the one before: it was
   solved, or stopped at the limit at a feasible point that costs no more. */
static int is_usable(const gpmpc_controller *controller)
{
    const gpmpc_problem *problem = &controller->problem;
    const gpmpc_program *program = &controller->program;
    const gpmpc_solution *solution = &controller->candidate;
    real before[GPMPC_SIZE];
    if (solution->status == GPMPC_SOLVED)
        return 1;
    if (solution->status != GPMPC_ITERATION_LIMIT || !all_finite(solution->x, N))
        return 0;
    if (!(hard_violation(program, solution->x) <= FEASIBLE))
        return 0;
    if (problem->has_feedback)
        fill(before, 0, N);
    else
        copy(&problem->inputs[0][0], before, N);
    return hard_violation(program, before) > FEASIBLE
           || objective(program, solution->x) <= objective(program, before);
}

#if GPMPC_ROLLS_OUT
/* Rolls the dynamics out towards the plan, so that it obeys them. Returns whether that
   ends in numbers: else the plan stays. */
static int close_defects(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    real states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    real inputs[GPMPC_SIZE];
    if (!problem->is_unstable)
        write_gains(problem);
    copy(&problem->states[0][0], states, (H + 1) * n);
    copy(&problem->inputs[0][0], inputs, H * m);
    follow(controller, states, inputs);
    if (!all_finite(states, (H + 1) * n))
        return 0;
    copy(states, &problem->states[0][0], (H + 1) * n);
    copy(inputs, &problem->inputs[0][0], H * m);
    return 1;
}
#endif

#if GPMPC_ROLLS_OUT
/* Takes the plan of the solution, rolled out where that ends in numbers and all
   functions are finite there; else as the program sees it, with the rows of the
   guess. */
static void take_rolled_out(gpmpc_controller *controller,
                            const gpmpc_reference *reference)
{
    gpmpc_problem *problem = &controller->problem;
    real *states = &problem->states[0][0];
    real *inputs = &problem->inputs[0][0];
#if GPMPC_SMOOTH || GPMPC_OUTPUTS
    real guessed_states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    real guessed_inputs[GPMPC_SIZE];
    int is_finite_there = 1;
    copy(states, guessed_states, (H + 1) * n);
    copy(inputs, guessed_inputs, H * m);
#else
    (void)reference;
#endif
    expand(problem, controller->candidate.x, inputs, states);
    if (!close_defects(controller))
        return;
#if GPMPC_SMOOTH || GPMPC_OUTPUTS
#if GPMPC_OUTPUTS
    is_finite_there = write_outputs(problem, reference);
#endif
    if (is_finite_there && write_rows(problem, reference))
        return;
    copy(guessed_states, states, (H + 1) * n);
    copy(guessed_inputs, inputs, H * m);
    (void)write_rows(problem, reference);
    expand(problem, controller->candidate.x, inputs, states);
#endif
}
#endif

/* Makes the problem at the states and inputs that the dynamics are linearised at.
   Returns whether all functions are finite. */
static int write_local_problem(gpmpc_controller *controller, const real *covariance,
                               const gpmpc_reference *reference)
{
    gpmpc_problem *problem = &controller->problem;
#if GPMPC_OUTPUTS
    if (!write_outputs(problem, reference))
        return 0;
#endif
#if GPMPC_TUBES
    write_gains(problem);
    predict_covariances(problem, covariance);
#else
    (void)covariance;
#endif
#if GPMPC_HELD
    if (controller->has_plan && !is_used_up(controller))
        write_step_model(controller);
#endif
    return write_rows(problem, reference);
}

/* Makes the problem at the first guess. Returns whether all functions are finite. */
static int write_problem(gpmpc_controller *controller, const real *state,
                         const real *covariance, const gpmpc_reference *reference)
{
    gpmpc_problem *problem = &controller->problem;
    copy(last_input(controller), problem->previous_input, m);
    read_reference(controller, state, reference);
    if (GPMPC_ESTIMATES)
        estimate_disturbance(controller, state);
    guess_states(controller, state);
    guess_inputs(controller);
    if (!linearize(controller)) {
        /* a guess that is dropped fails the step, too, where a function has no number */
#if GPMPC_OUTPUTS
        if (!write_outputs(problem, reference))
            return 0;
#endif
#if GPMPC_SMOOTH
        if (!write_smooth_rows(problem, reference))
            return 0;
#endif
        follow_inputs(controller);
        (void)linearize(controller);
    }
    return write_local_problem(controller, covariance, reference);
}

/* Solves the program of the problem at the guess. */
static void solve_local(gpmpc_controller *controller)
{
    condense(controller);
    solve(&controller->problem, &controller->program, &controller->solution,
          &controller->candidate);
#if GPMPC_ELASTIC
    solve_elastic(controller);
#endif
}

/* How a decision of a solved program ends: by the rows that its plan misses. */
static int end_of_solved(const gpmpc_controller *controller)
{
    const gpmpc_problem *problem = &controller->problem;
    real misses[GPMPC_AT_LEAST_ONE(GPMPC_STATE_ROWS)];
    int status = GPMPC_SOLVED;
    int k, e;
    if (GPMPC_ROLLS_OUT)
        write_misses_of_plan(problem, &problem->states[0][0], &problem->inputs[0][0],
                             misses);
    else
        write_misses(problem, &controller->candidate, misses);
    for (k = 0; k < H; k++)
        for (e = 0; e < r; e++) {
            real value = row_value(problem, k, e, problem->states[k + 1],
                                   problem->inputs[k]);
            real rounding = GPMPC_ROLLS_OUT ? ROUNDING_OF_SUMS * absolute(value) : 0;
            if (misses[k * r + e] <= KEPT + rounding)
                continue;
            if (is_hard(e))
                return GPMPC_HARD_BOUND_MISSED;
            status = GPMPC_SOFT_BOUND_MISSED;
        }
    return status;
}

/* Decides: solves the program of the problem at the first guess, and takes its step
   whole (the real-time iteration of Diehl, Bock and Schloeder, 2005). Writes plan and
   violation; returns the status, and whether the plan may be applied. */
static int decide(gpmpc_controller *controller, const real *state,
                  const real *covariance, const gpmpc_reference *reference,
                  int *applicable)
{
    gpmpc_problem *problem = &controller->problem;
    gpmpc_solution *solution = &controller->candidate;
    int status;
    *applicable = 0;
    if (!write_problem(controller, state, covariance, reference))
        return GPMPC_FUNCTION_NOT_FINITE;
    solve_local(controller);
    if (solution->status == GPMPC_INFEASIBLE && !controller->has_plan && !GPMPC_HELD) {
        /* A line through an obstacle may see it from both of its sides. */
        follow_inputs(controller);
        (void)linearize(controller);
        if (!write_local_problem(controller, covariance, reference))
            return GPMPC_FUNCTION_NOT_FINITE;
        solve_local(controller);
    }
    status = solution->status;
    if (!is_usable(controller))
        return status;
#if GPMPC_ROLLS_OUT
    take_rolled_out(controller, reference);
#else
    expand(problem, solution->x, &problem->inputs[0][0], &problem->states[0][0]);
#endif
    *applicable = status == GPMPC_SOLVED || keeps_hard_rows(problem, FEASIBLE);
#if GPMPC_ROLLS_OUT || !GPMPC_IS_FLOAT
    controller->violation = largest_violation(problem);
#else
    controller->violation = solution->violation; /* in doubled digits */
#endif
    return status == GPMPC_SOLVED ? end_of_solved(controller) : status;
}

/*{filter}*/
/* ------------------------------------------------------------------------------------
   The policy: what is applied, whatever happened (gpmpc/mpc/_policy.py).
   --------------------------------------------------------------------------------- */

/* Puts an input into the box and, among these, within the rates. */
static void keep_bounds(const gpmpc_controller *controller, real *input)
{
    const real *last = last_input(controller);
    int i;
    for (i = 0; i < m; i++)
        input[i] = within_box(within_rates(input[i], last[i], 0, i), 0, i);
}

/* Applies the first of planned inputs (H, m), put onto the bounds that it misses by
   rounding. Returns whether the plan may be applied. */
static int admit(gpmpc_controller *controller, real *inputs)
{
    const real rounding = REAL(1e-4);
    real input[GPMPC_INPUTS];
    int i;
    copy(inputs, input, m);
    keep_bounds(controller, input);
    for (i = 0; i < m; i++) {
        real miss = absolute(input[i] - inputs[i]);
        if (!(miss <= rounding * larger(1, absolute(input[i]))))
            return 0;
    }
    if (!all_finite(inputs, H * m))
        return 0;
    copy(input, inputs, m);
    copy(input, controller->input, m);
    controller->has_input = 1;
    return 1;
}

/* Moves the last plan on by a step, the last entry repeated. */
static int continue_last_plan(gpmpc_controller *controller)
{
    int k;
    if (!controller->has_plan)
        return 0;
    controller->policy_steps++;
    if (GPMPC_HOLDS && controller->policy_steps > 1)
        controller->policy_steps = H; /* what a held input leads to is not planned */
    for (k = 0; k < H; k++) {
        copy(controller->means[k + 1], controller->means[k], n);
        if (k < H - 1)
            copy(controller->inputs[k + 1], controller->inputs[k], m);
    }
    if (GPMPC_HOLDS)
        copy(controller->input, controller->inputs[0], m);
    keep_bounds(controller, controller->inputs[0]); /* bounds may change by stage */
    return admit(controller, &controller->inputs[0][0]);
}

/* Without a plan: the reference's input, or the initial one, within its bounds. */
static void apply_known_input(gpmpc_controller *controller,
                              const gpmpc_reference *reference)
{
    real input[GPMPC_INPUTS];
    int known = reference->has_inputs && all_finite(reference->inputs[0], m);
    copy(known ? reference->inputs[0] : initial_input, input, m);
    keep_bounds(controller, input);
    copy(input, controller->input, m);
    controller->has_input = 1;
    controller->has_plan = 0;
    controller->solution.rows = -1;
    fill(controller->disturbance, 0, n);
}

/* Takes the plan of the step for the one to go on from. Returns whether it may. */
static int take_plan(gpmpc_controller *controller)
{
    gpmpc_problem *problem = &controller->problem;
    if (!admit(controller, &problem->inputs[0][0]))
        return 0;
    copy(&problem->states[0][0], &controller->means[0][0], (H + 1) * n);
    copy(&problem->inputs[0][0], &controller->inputs[0][0], H * m);
    copy(controller->estimate, controller->disturbance, n);
    controller->solution = controller->candidate;
    controller->has_plan = 1;
    controller->policy_steps = 0;
    return 1;
}

void gpmpc_reset(gpmpc_controller *controller)
{
    int i;
    controller->has_input = 0;
    controller->has_plan = 0;
    controller->policy_steps = 0;
    controller->failed = 0;
    controller->status = GPMPC_SOLVED;
    controller->violation = 0;
    controller->problem.work.lane = -1;
    for (i = 0; i < GPMPC_KERNELS * GPMPC_LANES; i++)
        controller->problem.work.kernels[i] = 0; /* a lane may never be used */
    controller->solution.rows = -1;
    controller->solution.working = 0;
    controller->solution.status = GPMPC_SOLVED;
    fill(controller->disturbance, 0, n);
    fill(controller->estimate, 0, n);
#if GPMPC_FILTERS
    copy(first_mean, controller->belief.mean, n);
    copy(first_covariance, controller->belief.covariance, n * n);
#endif
}

void gpmpc_hold(gpmpc_reference *reference, const gpmpc_real state[GPMPC_STATES])
{
    int k;
    for (k = 0; k <= H; k++)
        copy(state, reference->states[k], n);
    fill(&reference->inputs[0][0], 0, H * m);
    fill(&reference->parameters[0][0], NAN, H * GPMPC_AT_LEAST_ONE(GPMPC_PARAMETERS));
    reference->has_inputs = 0;
}

/* Whether a reference holds all that is asked for: inputs that deviations are counted
   from, and parameters, which are measured as the state is. */
static int is_complete(const gpmpc_reference *reference)
{
    if (GPMPC_PENALIZED == DEVIATIONS && !reference->has_inputs)
        return 0;
    return all_finite(&reference->parameters[0][0], H * GPMPC_PARAMETERS);
}

int gpmpc_step_belief(gpmpc_controller *controller, const gpmpc_real mean[GPMPC_STATES],
                      const gpmpc_real covariance[GPMPC_STATES * GPMPC_STATES],
                      const gpmpc_reference *reference,
                      gpmpc_real input[GPMPC_INPUTS])
{
    int applicable = 0;
    int status = GPMPC_INVALID_MEASUREMENT;
    copy(controller->disturbance, controller->estimate, n);
    if (all_measured(mean, n) && all_finite(covariance, n * n)
        && is_complete(reference))
        status = decide(controller, mean, covariance, reference, &applicable);
    if (applicable && !take_plan(controller)) {
        applicable = 0;
        status = GPMPC_NUMERICAL_TROUBLE;
    }
    if (!applicable) {
        controller->violation = NAN;
        if (!continue_last_plan(controller))
            apply_known_input(controller, reference);
    }
    controller->status = status;
    controller->failed = !applicable;
    copy(controller->input, input, m);
    return status;
}

int gpmpc_step(gpmpc_controller *controller,
               const gpmpc_real measured[GPMPC_MEASURED],
               const gpmpc_reference *reference, gpmpc_real input[GPMPC_INPUTS])
{
#if GPMPC_FILTERS
    if (controller->has_input)
        predict_belief(controller);
    update_belief(controller, measured);
    return gpmpc_step_belief(controller, controller->belief.mean,
                             controller->belief.covariance, reference, input);
#else
    static const real certain[GPMPC_STATES * GPMPC_STATES] = {0};
    return gpmpc_step_belief(controller, measured, certain, reference, input);
#endif
}

unsigned long gpmpc_memory(void) { return (unsigned long)sizeof(gpmpc_controller); }

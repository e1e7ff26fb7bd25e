/* ------------------------------------------------------------------------------------
   What a solution leaves of the optimality conditions, in doubled digits.
   --------------------------------------------------------------------------------- */

/* The number x[i] + low[i], of which a program keeps both parts. */
static void add_to(real *x, real *low, int i, real change)
{
    Pair sum = pair_of(x[i], low[i]);
    add(&sum, change);
    sum = normalised(sum);
    x[i] = sum.high;
    low[i] = sum.low;
}

static Pair multiplier_of(const gpmpc_program *program, int p)
{
    return pair_of(program->multiplier[p], program->multiplier_low[p]);
}

#if GPMPC_IS_FLOAT
/* ------------------------------------------------------------------------------------
   In float the matrices of a condensed program are rounded sums: its solution misses
   that of the controller's problem by a thousandth of the inputs' range and more where
   states grow over the horizon. So what a solution leaves of the optimality conditions
   is computed along the dynamics, which are given, in doubled digits; P and G only say
   how to correct it.
   --------------------------------------------------------------------------------- */

typedef struct {
    Pair states[(GPMPC_HORIZON + 1) * GPMPC_STATES];
    Pair inputs[GPMPC_SIZE];
} Rollout;

/* sum <- sum + a'x */
static void add_dot(Pair *sum, const real *a, const Pair *x, int size)
{
    int i;
    for (i = 0; i < size; i++)
        if (a[i] != 0)
            add_multiple(sum, a[i], x[i]);
}

/* Writes the states and inputs of unknowns v; see ``expand``. */
static void roll_out(const gpmpc_problem *problem, const real *v, const real *low,
                     Rollout *rollout)
{
    Pair previous[GPMPC_INPUTS];
    int k, i;
    for (i = 0; i < n; i++)
        rollout->states[i] = pair_of(problem->states[0][i], 0);
    for (i = 0; i < m; i++)
        previous[i] = pair_of(problem->previous_input[i], 0);
    for (k = 0; k < H; k++) {
        const Pair *s = rollout->states + k * n;
        const Pair *last = k > 0 ? rollout->inputs + (k - 1) * m : previous;
        Pair *u = rollout->inputs + k * m;
        int stage = stage_of(k);
        for (i = 0; i < m; i++) {
            Pair input = pair_of(v[k * m + i], low[k * m + i]);
            if (problem->has_feedback) {
                const real *F = problem->feedback[k][i];
                add(&input, F[n + m]);
                add_dot(&input, F, s, n);
                add_dot(&input, F + n, last, m);
            }
            u[i] = normalised(input);
        }
        for (i = 0; i < n; i++) {
            Pair state = pair_of(problem->c[stage][i], problem->c_low[stage][i]);
            add_dot(&state, problem->A[stage][i], s, n);
            add_dot(&state, problem->B[stage][i], u, m);
            rollout->states[(k + 1) * n + i] = normalised(state);
        }
    }
}

/* E s_{k+1} + D u_k of row e at stage k. */
static Pair exact_row(const gpmpc_problem *problem, const Rollout *rollout, int k,
                      int e)
{
    Pair value = pair_of(0, 0);
    add_dot(&value, ROW_BY_STATE(problem, k, e), rollout->states + (k + 1) * n, n);
#if GPMPC_SMOOTH
    add_dot(&value, problem->D[k][e], rollout->inputs + k * m, m);
#endif
    return value;
}

/* Constraint p of a program counts from the solution v = 0: writes its value, given
   that of the inputs or states and the bounds that these have. */
static void write_exact_value(gpmpc_program *program, int p, Pair value, real low,
                              real high)
{
    if (is_finite(high)) {
        add(&value, -high);
        add(&value, program->upper[p]);
        value.low += program->upper_low[p];
    } else if (is_finite(low)) {
        add(&value, -low);
        add(&value, program->lower[p]);
        value.low += program->lower_low[p];
    }
    value = normalised(value);
    program->value[p] = value.high;
    program->value_low[p] = value.low;
}

/* u_k - u_{k-1} of input i. */
static Pair exact_rate(const gpmpc_problem *problem, const Pair *inputs, int k, int i)
{
    Pair rate = inputs[k * m + i];
    if (k > 0)
        add_multiple(&rate, -1, inputs[(k - 1) * m + i]);
    else
        add(&rate, -problem->previous_input[i]);
    return rate;
}

/* Writes the values of all rows along a rollout. */
static void write_exact_values(const gpmpc_problem *problem, const Rollout *rollout,
                               gpmpc_program *program)
{
    int first_rate = problem->has_feedback ? 2 * N : N;
    int first_row = first_rate + GPMPC_RATE_ROWS;
    int k, i, e;
    for (k = 0; k < H; k++) {
        for (i = 0; i < m; i++) {
            int j = k * m + i;
            if (problem->has_feedback)
                write_exact_value(program, N + j, rollout->inputs[j], input_lower[j],
                                  input_upper[j]);
            if (GPMPC_HAS_RATES)
                write_exact_value(program, first_rate + j,
                                  exact_rate(problem, rollout->inputs, k, i),
                                  rate_lower[j], rate_upper[j]);
        }
        for (e = 0; e < r; e++)
            write_exact_value(program, first_row + k * r + e,
                              exact_row(problem, rollout, k, e),
                              problem->row_lower[k][e], problem->row_upper[k][e]);
    }
}

/* slope <- slope + d/du_k of what inputs cost, and of bounds of inputs and rates */
static void add_input_slope(const gpmpc_problem *problem, const gpmpc_program *program,
                            const Pair *inputs, int k, Pair *slope)
{
    int first_rate = problem->has_feedback ? 2 * N : N;
    int i, j;
    for (j = 0; j < m; j++) {
        Pair deviation = inputs[k * m + j];
        if (GPMPC_PENALIZED == INCREMENTS)
            deviation = exact_rate(problem, inputs, k, j);
        if (GPMPC_PENALIZED == DEVIATIONS)
            add(&deviation, -problem->target_inputs[k][j]);
        for (i = 0; i < m; i++)
            add_multiple(&slope[i], 2 * input_weight(k)[i * m + j], deviation);
        if (GPMPC_PENALIZED == INCREMENTS && k + 1 < H) {
            Pair next = exact_rate(problem, inputs, k + 1, j);
            for (i = 0; i < m; i++)
                add_multiple(&slope[i], -2 * input_weight(k + 1)[i * m + j], next);
        }
    }
    for (i = 0; i < m; i++) {
        int p = k * m + i;
        add_multiple(&slope[i], 1,
                     multiplier_of(program, problem->has_feedback ? N + p : p));
        if (GPMPC_HAS_RATES)
            add_multiple(&slope[i], 1, multiplier_of(program, first_rate + p));
        if (GPMPC_HAS_RATES && k + 1 < H)
            add_multiple(&slope[i], -1, multiplier_of(program, first_rate + p + m));
    }
}

/* Adds d/ds_{k+1} and d/du_k of what a stage costs, and of its rows. */
static void add_stage_slopes(const gpmpc_problem *problem, const gpmpc_program *program,
                             const Rollout *rollout, int k, Pair *by_state,
                             Pair *by_input)
{
    const Pair *s = rollout->states + (k + 1) * n;
    const real *W = weight_of_stage(k);
    int first_row = (problem->has_feedback ? 2 * N : N) + GPMPC_RATE_ROWS + k * r;
    int i, j, e;
    (void)by_input;
    for (j = 0; j < n; j++) {
        Pair error = s[j];
        add(&error, -problem->targets[k + 1][j]);
        for (i = 0; i < n; i++)
            if (W[i * n + j] != 0)
                add_multiple(&by_state[i], 2 * W[i * n + j], error);
    }
#if GPMPC_OUTPUTS
    for (i = 0; i < n + m; i++) {
        const real *Z = problem->Z[k][i];
        Pair slope = pair_of(Z[n + m], 0);
        add_dot(&slope, Z, s, n);
        add_dot(&slope, Z + n, rollout->inputs + k * m, m);
        add_multiple(i < n ? &by_state[i] : &by_input[i - n], 2, slope);
    }
#endif
    for (e = 0; e < r; e++) {
        Pair multiplier = multiplier_of(program, first_row + e);
        if (multiplier.high == 0)
            continue;
        for (i = 0; i < n; i++)
            add_multiple(&by_state[i], ROW_BY_STATE(problem, k, e)[i], multiplier);
#if GPMPC_SMOOTH
        for (i = 0; i < m; i++)
            add_multiple(&by_input[i], problem->D[k][e][i], multiplier);
#endif
    }
}

/* Writes the gradient of the Lagrangian by v, by the adjoint recursion. */
static void write_exact_gradient(const gpmpc_problem *problem, const Rollout *rollout,
                                 gpmpc_program *program)
{
    Pair costate[GPMPC_STATES + GPMPC_INPUTS]; /* by s_{k+1}, and by u_k through F */
    int k, i, j;
    for (i = 0; i < n + m; i++)
        costate[i] = pair_of(0, 0);
    for (k = H - 1; k >= 0; k--) {
        Pair *slope = costate + n;
        Pair before[GPMPC_STATES + GPMPC_INPUTS];
        int stage = stage_of(k);
        add_stage_slopes(problem, program, rollout, k, costate, slope);
        add_input_slope(problem, program, rollout->inputs, k, slope);
        for (i = 0; i < n; i++) {
            costate[i] = normalised(costate[i]);
            for (j = 0; j < m; j++)
                add_multiple(&slope[j], problem->B[stage][i][j], costate[i]);
        }
        for (i = 0; i < n + m; i++)
            before[i] = pair_of(0, 0);
        for (i = 0; i < n; i++)
            for (j = 0; j < n; j++)
                if (problem->A[stage][i][j] != 0)
                    add_multiple(&before[j], problem->A[stage][i][j], costate[i]);
        for (i = 0; i < m; i++) {
            slope[i] = normalised(slope[i]);
            program->gradient[k * m + i] = slope[i].high;
            for (j = 0; j < n + m && problem->has_feedback; j++)
                add_multiple(&before[j], problem->feedback[k][i][j], slope[i]);
        }
        for (i = 0; i < n + m; i++)
            costate[i] = normalised(before[i]);
    }
}

/* Writes gradient and values of the present x and multipliers. */
static void evaluate_along_dynamics(const gpmpc_problem *problem,
                                    gpmpc_program *program)
{
    Rollout rollout;
    roll_out(problem, program->value, program->value_low, &rollout);
    write_exact_values(problem, &rollout, program);
    write_exact_gradient(problem, &rollout, program);
}
#endif

/* The same by P, q, G and the bounds of a program as they are. */
static void evaluate_program(gpmpc_program *program)
{
    int i, j;
    for (j = 0; j < N; j++) {
        Pair sum = pair_of(program->q[j], 0);
        for (i = 0; i < N; i++)
            add_multiple(&sum, program->P[j][i],
                         pair_of(program->value[i], program->value_low[i]));
        add_multiple(&sum, 1, multiplier_of(program, j));
        for (i = 0; i < program->rows; i++)
            if (program->multiplier[N + i] != 0)
                add_multiple(&sum, program->G[i][j], multiplier_of(program, N + i));
        program->gradient[j] = rounded(sum);
    }
    for (i = 0; i < program->rows; i++) {
        Pair sum = pair_of(0, 0);
        for (j = 0; j < program->row_end[N + i]; j++)
            add_multiple(&sum, program->G[i][j],
                         pair_of(program->value[j], program->value_low[j]));
        sum = normalised(sum);
        program->value[N + i] = sum.high;
        program->value_low[N + i] = sum.low;
    }
}

/* By how much constraint p is above its upper bound, and below its lower one. */
static real above_bound(const gpmpc_program *program, int p)
{
    return (program->value[p] - program->upper[p])
           + (program->value_low[p] - program->upper_low[p]);
}

static real below_bound(const gpmpc_program *program, int p)
{
    return (program->lower[p] - program->value[p])
           + (program->lower_low[p] - program->value_low[p]);
}

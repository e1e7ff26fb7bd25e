/* ------------------------------------------------------------------------------------
   The dual active-set method (Goldfarb and Idnani, 1983) for

     minimise 1/2 x'Px + q'x   subject to   lower <= C x <= upper,   C = [I; G]

   as in gpmpc/qp/_dual_iteration.py, where it is explained. A constraint p is
   represented by w_p = L^-T c_p with P = L'L, so that K_pq = c_p'P^-1 c_q = w_p'w_q.
   The working set is a list of k slots, each with a row of the factor of K_WW. N is the
   number of variables, r that of rows at a stage, H that of stages (core.c).
   --------------------------------------------------------------------------------- */

enum { BATCHES = 4, ROUNDS = 10, REFINEMENTS = GPMPC_IS_FLOAT ? 6 : 3 };

/* The largest number of changes of the working set in a try that follows others. A limit
   that was asked for is one of all tries; an ample one begins anew. */
static int changes_left(const gpmpc_program *program, int changes_before)
{
    if (GPMPC_ITERATIONS > 0)
        return GPMPC_ITERATIONS - changes_before;
    return 100 + 10 * (N + program->rows);
}

static int constraint_count(const gpmpc_program *program) { return N + program->rows; }

/* Constraint p of a label p + 1 (at its upper bound) or -(p + 1) (at its lower one). */
static int constraint_of(int label) { return abs(label) - 1; }

static int constraint_in(const gpmpc_program *program, int slot)
{
    return constraint_of(program->label[slot]);
}

/* a <- L^-1 a, L (k, k) in rows of ``stride`` with reciprocals on its diagonal */
static void solve_lower(const real *L, int stride, int k, real *a)
{
    int i;
    for (i = 0; i < k; i++) {
        const real *row = L + i * stride;
        a[i] = (a[i] - dot(row, a, i)) * row[i];
    }
}

/* a <- L^-T a for a vector that is zero from ``end`` on */
static void solve_transposed(const real *L, int stride, int end, real *a)
{
    int j;
    for (j = end - 1; j >= 0; j--) {
        const real *row = L + j * stride;
        a[j] *= row[j];
        add_scaled(-a[j], row, a, j);
    }
}

/* Writes L of P = L'L, from the last variable to the first, so that a row that ends
   early has as short a w_p. Returns whether P is positive definite and finite. */
static int factorise(gpmpc_program *program)
{
    int i, j;
    for (i = N - 1; i >= 0; i--) {
        real *row = program->L[i];
        real pivot;
        copy(program->P[i], row, i + 1);
        if (i < N - 1)
            add_combination(-1, &program->L[i + 1][i], N, program->L + i + 1,
                            N - 1 - i, row, i + 1);
        pivot = row[i];
        if (!(pivot > N * PIVOT_ROUNDING * program->P[i][i]) || !is_finite(pivot))
            return 0;
        pivot = 1 / SQRT(pivot);
        for (j = 0; j < i; j++)
            row[j] *= pivot;
        row[i] = pivot;
    }
    return 1;
}

/* Writes the norms and where rows of G end. The norm of a row whose squares underflow is
   its largest entry: no factor here can hold it, but its violation is seen. That of a
   row of zeros is one. Returns what cancellation left of the pivots of P, as a share of
   P_ii; zero if a norm is not finite. */
static real measure_rows(gpmpc_program *program)
{
    real *units = program->scratch;
    real cancelled = 1;
    real undefined = 0;
    int i, j;
    for (i = 0; i < N; i++) {
        units[i] = 1 / SQRT(program->P[i][i]);
        program->norm[i] = units[i];
        program->row_end[i] = i + 1;
        cancelled =
            larger(cancelled, program->L[i][i] * program->L[i][i] * program->P[i][i]);
    }
    for (i = 0; i < program->rows; i++) {
        const real *row = program->G[i];
        real squares = 0;
        real largest = 0;
        real norm;
        int end = 0;
        for (j = 0; j < N; j++) {
            real value = row[j] * units[j];
            squares += value * value;
            largest = larger(largest, absolute(value));
            if (row[j] != 0)
                end = j + 1;
        }
        norm = SQRT(squares);
        if (norm == 0)
            norm = largest;
        undefined += norm * 0;
        program->norm[N + i] = norm > 0 ? norm : 1;
        program->row_end[N + i] = end;
    }
    return undefined == 0 ? 1 / cancelled : 0;
}

/* Lets constraint p, outside the working set, count as violated: with a
   multiplier of zero beyond its bounds, at a cap inside the bound that it violates. */
static void watch(gpmpc_program *program, int p)
{
    real low = program->lower[p];
    real high = program->upper[p];
    real below = is_finite(low) ? TOLERATED * absolute(low) : 0;
    real above = is_finite(high) ? TOLERATED * absolute(high) : 0;
    program->allowed_low[p] = low - (below + program->negligible[p]);
    program->allowed_high[p] = high + (above + program->negligible[p]);
    if (program->multiplier[p] > 0) {
        program->allowed_low[p] = high - (above + program->negligible[p]);
        program->allowed_high[p] = INFINITY;
    } else if (program->multiplier[p] < 0) {
        program->allowed_low[p] = -INFINITY;
        program->allowed_high[p] = low + (below + program->negligible[p]);
    }
}

/* Reads the bounds, absent ones as infinite, and clears the multipliers. Returns
   whether none are crossed or undefined. */
static int read_bounds(gpmpc_program *program)
{
    int M = constraint_count(program);
    int p;
    for (p = 0; p < M; p++) {
        real low = program->lower[p];
        real high = program->upper[p];
        if (!(low <= high))
            return 0;
        if (low <= -ABSENT)
            low = -INFINITY;
        if (high >= ABSENT)
            high = INFINITY;
        if (low > LARGEST || high < -LARGEST)
            return 0;
        program->lower[p] = low;
        program->upper[p] = high;
        program->negligible[p] = program->negligible_length * program->norm[p];
        program->multiplier[p] = 0;
        program->multiplier_low[p] = 0;
        watch(program, p);
    }
    return 1;
}

/* Lets constraint p count as satisfied whatever its value: it is in the working set,
   or cannot be told from one that is. */
static void stop_watching(gpmpc_program *program, int p)
{
    program->allowed_low[p] = -INFINITY;
    program->allowed_high[p] = INFINITY;
}

static int is_watched(const gpmpc_program *program, int p)
{
    return program->allowed_low[p] > -LARGEST || program->allowed_high[p] < LARGEST;
}

/* The value of a row of G at the present x. */
static void write_value(gpmpc_program *program, int row)
{
    int end = program->row_end[N + row];
    program->value[N + row] = dot(program->G[row], program->value, end);
    program->value_low[N + row] = 0;
}

static void multiply_constraints(gpmpc_program *program)
{
    int row;
    for (row = 0; row < program->rows; row++)
        write_value(program, row);
}

static real outside(const gpmpc_program *program, int p)
{
    real above = (program->value[p] - program->allowed_high[p])
                 + (program->value_low[p] - program->upper_low[p]);
    real below = (program->allowed_low[p] - program->value[p])
                 + (program->lower_low[p] - program->value_low[p]);
    return larger(above, below);
}

/* Lists the constraints violated by more than a margin, both in units of the norm. */
static int list_violated(gpmpc_program *program, real margin)
{
    int count = 0;
    int p;
    for (p = 0; p < constraint_count(program); p++) {
        real excess = outside(program, p) - margin * program->norm[p];
        if (excess > 0) {
            program->excess[p] = excess / program->norm[p];
            program->violated[count++] = p;
        }
    }
    return count;
}

/* Keeps the listed constraints that are still violated. */
static int recheck_violated(gpmpc_program *program, real margin, int count)
{
    int remaining = 0;
    int i;
    for (i = 0; i < count; i++) {
        int p = program->violated[i];
        if (p >= N)
            write_value(program, p - N);
        program->excess[p] = outside(program, p) / program->norm[p] - margin;
        if (program->excess[p] > 0)
            program->violated[remaining++] = p;
    }
    return remaining;
}

static int most_violated(const gpmpc_program *program, int count)
{
    int worst = program->violated[0];
    int i;
    for (i = 1; i < count; i++)
        if (program->excess[program->violated[i]] > program->excess[worst])
            worst = program->violated[i];
    return worst;
}

/* Makes candidates of the constraints violated nearly as badly as the worst; none
   where only one is. */
static int choose_badly_violated(gpmpc_program *program, real threshold, int count,
                                 int most)
{
    int chosen = 0;
    int bad = 0;
    int i;
    for (i = 0; i < count; i++) {
        int p = program->violated[i];
        if (!(program->excess[p] > threshold))
            continue;
        bad++;
        if (chosen < most && program->multiplier[p] == 0) {
            int at_upper = program->value[p] > program->upper[p];
            program->candidates[chosen++] = at_upper ? p + 1 : -(p + 1);
        }
    }
    return bad > 1 ? chosen : 0;
}

/* Makes candidates of the working set of a guess. */
static int choose_guessed(gpmpc_program *program, const gpmpc_solution *guess)
{
    int chosen = 0;
    int i;
    for (i = 0; i < guess->working; i++) {
        int label = guess->label[i];
        int p = constraint_of(label);
        real bound;
        if (p < 0 || p >= constraint_count(program))
            continue;
        bound = label > 0 ? program->upper[p] : program->lower[p];
        if (program->multiplier[p] == 0 && is_finite(bound))
            program->candidates[chosen++] = label;
    }
    return chosen;
}

/* Writes w_p = L^-T c_p. */
static void write_column(const gpmpc_program *program, int p, real *w)
{
    int end = program->row_end[p];
    fill(w, 0, N);
    if (p < N)
        w[p] = 1;
    else
        copy(program->G[p - N], w, end);
    solve_transposed(&program->L[0][0], N, end, w);
}

/* Writes constraint p, at its upper or its lower bound, to slot k. */
static void write_slot(gpmpc_program *program, int k, int p, int at_upper)
{
    real *w = program->w[program->place[k]];
    int equality = program->lower[p] == program->upper[p];
    real cap = program->cap[p];
    write_column(program, p, w);
    program->diagonal[k] = dot(w, w, program->row_end[p]);
    program->label[k] = at_upper ? p + 1 : -(p + 1);
    program->bound[k] = at_upper ? program->upper[p] : program->lower[p];
    program->least_multiplier[k] = equality || !at_upper ? -cap : 0;
    program->most_multiplier[k] = equality || at_upper ? cap : 0;
    program->free_value[k] = dot(w, program->free_rhs, N);
}

/* Writes L_K^-1 K_Wp, the row that p in slot k would add to the factor. */
static void compute_factor_row(gpmpc_program *program, int k, int p)
{
    const real *w = program->w[program->place[k]];
    int i;
    for (i = 0; i < k; i++)
        program->forward[i] =
            dot(program->w[program->place[i]], w, program->row_end[p]);
    solve_lower(&program->factor[0][0], GPMPC_SLOTS, k, program->forward);
}

/* target <- target - sum_i factors[i] w_i */
static void subtract_working(const gpmpc_program *program, const real *factors, int k,
                             real *target)
{
    int i;
    for (i = 0; i < k; i++)
        add_scaled(-factors[i], program->w[program->place[i]], target, N);
}

/* d = |w_p - sum r_i w_i|^2, r = direction: as a sum of squares it cannot cancel */
static real distance_to_span(gpmpc_program *program, int k)
{
    copy(program->w[program->place[k]], program->scratch, N);
    subtract_working(program, program->direction, k, program->scratch);
    return dot(program->scratch, program->scratch, N);
}

/* Adds p, in slot k, whose row of the factor is ``forward``; pivot > 0. */
static int add_constraint(gpmpc_program *program, int k, int p, real pivot)
{
    copy(program->forward, program->factor[k], k);
    program->factor[k][k] = 1 / SQRT(pivot);
    stop_watching(program, p);
    return k + 1;
}

/* Adds candidates, but for those that depend on others. */
static int add_candidates(gpmpc_program *program, int k, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        int label = program->candidates[i];
        int p = constraint_of(label);
        real pivot;
        if (!is_watched(program, p) || k >= N)
            continue;
        write_slot(program, k, p, label > 0);
        compute_factor_row(program, k, p);
        pivot = program->diagonal[k] - dot(program->forward, program->forward, k);
        if (pivot > CANDIDATE_PIVOT * program->diagonal[k])
            k = add_constraint(program, k, p, pivot);
    }
    return k;
}

/* Deletes row ``gone`` of the factor of k rows, and its entry of ``forward``, by Givens
   rotations (Golub and Van Loan, Matrix Computations, section 6.5.2). */
static void delete_row(gpmpc_program *program, int k, int gone)
{
    real left = program->forward[gone];
    int i, j;
    for (i = gone + 1; i < k; i++) {
        const real *row = program->factor[i];
        real *above = program->factor[i - 1];
        real rest = row[gone];
        real below = program->forward[i];
        real diagonal, reciprocal;
        copy(row, above, gone);
        for (j = gone + 1; j < i; j++) {
            real entry = row[j];
            above[j - 1] = program->cosines[j] * rest + program->sines[j] * entry;
            rest = program->cosines[j] * entry - program->sines[j] * rest;
        }
        diagonal = 1 / row[i];
        reciprocal = 1 / SQRT(rest * rest + diagonal * diagonal);
        program->cosines[i] = rest * reciprocal;
        program->sines[i] = diagonal * reciprocal;
        above[i - 1] = reciprocal;
        program->forward[i - 1] =
            program->cosines[i] * left + program->sines[i] * below;
        left = program->cosines[i] * below - program->sines[i] * left;
    }
}

/* Drops the constraint in a slot; those behind it, up to slot k, go one slot down. */
static void drop_constraint(gpmpc_program *program, int k, int slot)
{
    int free_place = program->place[slot];
    int i;
    delete_row(program, k, slot);
    for (i = slot; i < k; i++) {
        program->label[i] = program->label[i + 1];
        program->place[i] = program->place[i + 1];
        program->bound[i] = program->bound[i + 1];
        program->free_value[i] = program->free_value[i + 1];
        program->least_multiplier[i] = program->least_multiplier[i + 1];
        program->most_multiplier[i] = program->most_multiplier[i + 1];
        program->diagonal[i] = program->diagonal[i + 1];
    }
    program->place[k] = free_place;
}

/* slope = q + C'multiplier; only where rows are soft can others than the k working
   ones have a multiplier */
static void add_multipliers(gpmpc_program *program, int k)
{
    int count = program->soft ? program->rows : k;
    int i, j;
    for (j = 0; j < N; j++)
        program->slope[j] = program->q[j] + program->multiplier[j];
    for (i = 0; i < count; i++) {
        int p = program->soft ? N + i : constraint_in(program, i);
        if (p >= N && program->multiplier[p] != 0)
            add_scaled(program->multiplier[p], program->G[p - N], program->slope,
                       program->row_end[p]);
    }
}

/* Writes the minimiser of the Lagrangian, P x = -(q + C'mu). */
static void minimise(gpmpc_program *program, int k)
{
    real *x = program->value;
    int i;
    if (program->soft) { /* constraints at their caps have multipliers, too */
        add_multipliers(program, k);
        for (i = 0; i < N; i++)
            x[i] = -program->slope[i];
        solve_transposed(&program->L[0][0], N, N, x);
    } else { /* L x = free_rhs - sum mu_i w_i */
        copy(program->free_rhs, x, N);
        for (i = 0; i < k; i++)
            program->scratch[i] = program->multiplier[constraint_in(program, i)];
        subtract_working(program, program->scratch, k, x);
    }
    solve_lower(&program->L[0][0], N, N, x);
    fill(program->value_low, 0, N);
}

/* Where the range of a multiplier ends that decreases at this rate. */
static real end_of_range(const gpmpc_program *program, int slot, real rate)
{
    return rate > 0 ? program->least_multiplier[slot] : program->most_multiplier[slot];
}

/* Shortens a step so that it keeps the multipliers in range; returns the slot that ends
   it, or k. A rate r_i that may be rounding blocks nothing. The unit of r_i is that of
   its row, so it is weighed by the length of w_i, whose square is K_ii. */
static int first_blocking(const gpmpc_program *program, int k, real sense, real *step)
{
    real largest_square = 0;
    real rounding;
    int blocking = k;
    int i;
    for (i = 0; i < k; i++) {
        real rate = program->direction[i];
        largest_square = larger(largest_square, rate * rate * program->diagonal[i]);
    }
    rounding = NO_RATE * NO_RATE * largest_square;
    for (i = 0; i < k; i++) {
        real rate = sense * program->direction[i];
        real room;
        if (!(rate * rate * program->diagonal[i] > rounding))
            continue;
        room = (program->multiplier[constraint_in(program, i)]
                - end_of_range(program, i, rate)) / rate;
        if (room < *step) {
            *step = larger(room, 0);
            blocking = i;
        }
    }
    return blocking;
}

/* Moves multipliers until constraint p is satisfied: steps 1 and 2 of algorithm 1.
   Returns whether it does not contradict the working ones. */
static int satisfy_constraint(gpmpc_program *program, int *size, int p, int *changes)
{
    real *mu = program->multiplier;
    int k = *size;
    int at_upper;
    real sense, violation;
    if (mu[p] == 0) {
        at_upper = program->value[p] > program->upper[p];
        sense = at_upper ? 1 : -1; /* the direction in which mu_p moves */
    } else { /* it comes back from a cap: p holds, and need not be paid for */
        at_upper = mu[p] > 0;
        sense = at_upper ? -1 : 1;
    }
    write_slot(program, k, p, at_upper);
    compute_factor_row(program, k, p);
    violation = sense * (at_upper ? above_bound(program, p) : -below_bound(program, p));
    for (;;) {
        real K_pp = program->diagonal[k];
        real d, step, room, range_end;
        int reaches_range_end, blocking, i;
        /* direction: r = K_WW^-1 K_Wp, d = K_pp - K_pW r */
        copy(program->forward, program->direction, k);
        solve_transposed(&program->factor[0][0], GPMPC_SLOTS, k, program->direction);
        d = K_pp - dot(program->forward, program->forward, k);
        if (d < DOUBTFUL_SQUARE * K_pp)
            d = distance_to_span(program, k);
        /* length: until p holds, its multiplier is at the end of its range (its cap, or
           zero on the way back), or a working one is */
        step = d > DEPENDENT_SQUARE * K_pp && k < N ? larger(0, violation) / d
                                                    : INFINITY;
        range_end =
            sense > 0 ? program->most_multiplier[k] : program->least_multiplier[k];
        room = (range_end - mu[p]) * sense;
        reaches_range_end = room < step;
        if (reaches_range_end)
            step = room;
        blocking = first_blocking(program, k, sense, &step);
        if (step > LARGEST) { /* (r, -1) is Farkas' proof, unless rounding violates p */
            *size = k;
            return 0;
        }
        for (i = 0; i < k; i++)
            mu[constraint_in(program, i)] -= sense * step * program->direction[i];
        mu[p] += sense * step;
        (*changes)++;
        if (blocking < k) { /* partial step: drop what blocks, and try p again */
            int leaving = constraint_in(program, blocking);
            mu[leaving] = end_of_range(program, blocking,
                                       sense * program->direction[blocking]);
            drop_constraint(program, k, blocking);
            k--;
            watch(program, leaving);
            violation -= step * d;
        } else if (reaches_range_end) { /* stays violated at its cap, or holds */
            mu[p] = range_end;
            watch(program, p);
            *size = k;
            return 1;
        } else { /* full step: add p */
            *size = add_constraint(program, k, p, d);
            return 1;
        }
    }
}

/* sum |r_i b_i|, of which the value of the combination sum r_i c_i is made */
static real terms_of_combination(const gpmpc_program *program, int k)
{
    real terms = 0;
    int i;
    for (i = 0; i < k; i++)
        terms += absolute(program->direction[i] * program->bound[i]);
    return terms;
}

/* Whether p contradicts the working set by more than rounding. */
static int is_contradiction(const gpmpc_program *program, int p, real terms)
{
    real size = larger(larger(absolute(program->value[p]), terms),
                       program->length_of_q * program->norm[p]);
    return program->excess[p] * program->norm[p] > HOPELESS * size;
}

/* Writes Farkas' proof that p contradicts the working set to the multipliers. */
static void write_ray(gpmpc_program *program, int k, int p)
{
    real sense = program->value[p] > program->upper[p] ? 1 : -1;
    int i;
    fill(program->multiplier, 0, constraint_count(program));
    for (i = 0; i < k; i++) {
        int constraint = constraint_in(program, i);
        real ray = -sense * program->direction[i];
        if (ray * (real)program->label[i] >= 0
            || program->lower[constraint] == program->upper[constraint])
            program->multiplier[constraint] = ray;
    }
    program->multiplier[p] = sense;
}

/* Solves K_WW mu = y_W - b_W; drops the most wrong one until all are in range. */
static int drop_wrong_multipliers(gpmpc_program *program, int k)
{
    real *trial = program->direction;
    int i;
    for (i = 0; i < k; i++)
        program->forward[i] = program->free_value[i] - program->bound[i];
    solve_lower(&program->factor[0][0], GPMPC_SLOTS, k, program->forward);
    for (;;) {
        real worst = 0;
        int slot = k;
        int p;
        copy(program->forward, trial, k);
        solve_transposed(&program->factor[0][0], GPMPC_SLOTS, k, trial);
        for (i = 0; i < k; i++) {
            real beyond = larger(trial[i] - program->most_multiplier[i],
                                 program->least_multiplier[i] - trial[i]);
            if (beyond > worst) {
                worst = beyond;
                slot = i;
            }
        }
        if (slot == k)
            break;
        p = constraint_in(program, slot);
        drop_constraint(program, k, slot);
        k--;
        program->multiplier[p] = 0;
        watch(program, p);
    }
    for (i = 0; i < k; i++)
        program->multiplier[constraint_in(program, i)] = trial[i];
    return k;
}

static void clip_multiplier(gpmpc_program *program, int slot, real value)
{
    program->multiplier[constraint_in(program, slot)] =
        smaller(larger(value, program->least_multiplier[slot]),
                program->most_multiplier[slot]);
}

/* Puts the working multipliers into their ranges, which rounding can leave. */
static void clip_multipliers(gpmpc_program *program, int k)
{
    int i;
    for (i = 0; i < k; i++)
        clip_multiplier(program, i, program->multiplier[constraint_in(program, i)]);
}

/* The state of the iteration, from round to round. */
typedef struct {
    int status;
    int size;       /* k, of the working set */
    int iterations;
    int limit;      /* of the iterations */
    int batches_left;
    int passed_over; /* whether one contradicts others by what may be rounding */
} Progress;

/* Adds and drops constraints until none is violated by more than ``margin``. */
static void iterate(gpmpc_program *program, Progress *progress, int starts, int guessed,
                    int count, real margin)
{
    int candidates = guessed;
    int all_listed = 1; /* whether the list was made of all constraints */
    int k = progress->size;
    int violated = 0;
    fill(program->multiplier_low, 0, constraint_count(program));
    progress->status = GPMPC_SOLVED;
    while (starts || count > 0) {
        int size_before = k;
        int multipliers_fit = 0;
        int single, p = 0, look_at_all;
        if (!starts) { /* select the violated constraint p, or several at once */
            violated = 1;
            if (progress->iterations >= progress->limit) {
                progress->status = GPMPC_ITERATION_LIMIT;
                break;
            }
            p = most_violated(program, count);
            candidates = 0;
            if (all_listed && progress->batches_left > 0) {
                candidates = choose_badly_violated(program, program->excess[p] / 2,
                                                   count, N - k);
                progress->batches_left -= candidates > 0;
            }
        }
        k = add_candidates(program, k, candidates);
        single = !starts && k == size_before;
        if (single) {
            real multiplier_before = program->multiplier[p];
            int satisfied =
                satisfy_constraint(program, &k, p, &progress->iterations);
            multipliers_fit = 1;
            if (!satisfied) {
                real terms = terms_of_combination(program, k);
                if (is_contradiction(program, p, terms)) {
                    write_ray(program, k, p);
                    progress->status = GPMPC_INFEASIBLE;
                    break;
                }
                /* pass p over: it contradicts the others by rounding */
                program->multiplier[p] = multiplier_before;
                program->negligible[p] += ROUNDING_OF_BOUNDS * terms;
                stop_watching(program, p);
                progress->passed_over = 1;
                multipliers_fit = program->soft;
            }
            if (program->soft)
                progress->batches_left = 0;
        } else if (!starts) {
            progress->iterations += k - size_before;
        }
        if (!multipliers_fit)
            k = drop_wrong_multipliers(program, k);
        minimise(program, k);
        /* first satisfy those that were seen to be violated, then look at all */
        look_at_all = count == 1 || program->soft
                      || progress->iterations >= progress->limit;
        all_listed = look_at_all || !single;
        if (!all_listed) {
            count = recheck_violated(program, margin, count);
            all_listed = count == 0;
        }
        if (all_listed) {
            multiply_constraints(program);
            count = list_violated(program, margin);
        }
        starts = 0;
    }
    if (progress->status == GPMPC_SOLVED && violated)
        clip_multipliers(program, k);
    progress->size = k;
}

/* A working constraint's residual by x, or a hundredth by its own terms. */
static real relative_residual(const gpmpc_program *program, int slot, real residual,
                              real length)
{
    int p = constraint_in(program, slot);
    real scaled_length = length * program->norm[p];
    real terms;
    if (!(residual > FINEST * scaled_length))
        return 0;
    terms = larger(absolute(program->bound[slot]), REAL(1e-6) * scaled_length);
    if (p >= N && residual > ROW_RESIDUAL * terms) {
        int j;
        for (j = 0; j < program->row_end[p]; j++)
            terms = larger(terms, absolute(program->G[p - N][j] * program->value[j]));
    }
    return larger(residual / scaled_length, residual / (100 * terms));
}

/* Writes the gradient of the Lagrangian by x, and returns the square of the length of
   x; in float the values of rows are written, too. */
static real write_lagrangian(const gpmpc_problem *problem, gpmpc_program *program)
{
    const real *x = program->value;
    real square;
#if GPMPC_IS_FLOAT
    multiply(&program->P[0][0], x, N, N, program->scratch);
    square = dot(program->scratch, x, N);
    evaluate_along_dynamics(problem, program);
#else
    (void)problem;
    multiply(&program->P[0][0], x, N, N, program->gradient);
    square = dot(program->gradient, x, N);
    add_scaled(1, program->slope, program->gradient, N);
#endif
    return square;
}

/* How far a working constraint is above its bound. */
static real slot_residual(const gpmpc_program *program, int slot)
{
    int p = constraint_in(program, slot);
    if (program->label[slot] > 0)
        return above_bound(program, p);
    return -below_bound(program, p);
}

/* Returns the residual of x on the working set as a share of the length of x, UNDEFINED
   where a number is not finite; writes the length. */
static real measure_residual(const gpmpc_problem *problem, gpmpc_program *program,
                             int k, real *length)
{
    const real *x = program->value;
    real least = program->negligible_length;
    real steps = 0;
    real shifts = 0;
    real entries = TINY;
    real undefined = 0;
    real worst;
    int i, j;
    real square = write_lagrangian(problem, program);
    *length = SQRT(larger(larger(square, least * least), TINY));
    for (j = 0; j < N; j++) {
        real step = absolute(program->gradient[j]) * program->norm[j];
        steps = larger(steps, step);
        shifts = larger(shifts, step * program->norm[j]);
        entries = larger(entries, absolute(x[j]));
        undefined += 0 * step;
    }
    worst = larger(steps / *length, shifts / (100 * entries));
    for (i = 0; i < k; i++) {
        real residual = slot_residual(program, i);
        program->residual[i] = residual;
        worst = larger(worst,
                       relative_residual(program, i, absolute(residual), *length));
        undefined += 0 * residual;
    }
    return is_finite(worst + undefined + *length) ? worst : UNDEFINED;
}

/* x[i] <- x[i] + change; in float with what that rounds off */
static void correct(real *x, real *low, int i, real change)
{
    if (GPMPC_IS_FLOAT)
        add_to(x, low, i, change);
    else
        x[i] += change;
}

/* Takes one Newton step for the residuals; multipliers stay in range. */
static void take_newton_step(gpmpc_program *program, int k)
{
    real *transformed = program->scratch; /* L^-T gradient */
    real *dmu = program->direction;       /* K_WW^-1 (residual - W transformed) */
    real *dx = program->gradient;         /* -L^-1 (transformed + sum dmu_i w_i) */
    int i;
    copy(program->gradient, transformed, N);
    solve_transposed(&program->L[0][0], N, N, transformed);
    for (i = 0; i < k; i++)
        dmu[i] = program->residual[i]
                 - dot(program->w[program->place[i]], transformed, N);
    solve_lower(&program->factor[0][0], GPMPC_SLOTS, k, dmu);
    solve_transposed(&program->factor[0][0], GPMPC_SLOTS, k, dmu);
    for (i = 0; i < N; i++)
        dx[i] = -transformed[i];
    subtract_working(program, dmu, k, dx);
    solve_lower(&program->L[0][0], N, N, dx);
    for (i = 0; i < N; i++)
        correct(program->value, program->value_low, i, dx[i]);
    for (i = 0; i < k; i++) {
        int p = constraint_in(program, i);
        real unclipped;
        correct(program->multiplier, program->multiplier_low, p, dmu[i]);
        unclipped = program->multiplier[p];
        clip_multiplier(program, i, unclipped);
        if (program->multiplier[p] != unclipped)
            program->multiplier_low[p] = 0;
    }
    if (!GPMPC_IS_FLOAT) /* there values come with the residuals */
        multiply_constraints(program);
}

/* Corrects x and the multipliers on the working set until their residual is small, or
   does not halve any more. Returns the residual. */
static real refine(const gpmpc_problem *problem, gpmpc_program *program, int k,
                   real tolerance, real *length)
{
    real best = INFINITY;
    real residual = INFINITY;
    int step;
    for (step = 0; step <= REFINEMENTS; step++) {
        add_multipliers(program, k);
        residual = measure_residual(problem, program, k, length);
        if (residual <= tolerance || step == REFINEMENTS || !(residual < best / 2))
            break;
        best = residual;
        take_newton_step(program, k);
    }
    return residual;
}

/* The largest violation beyond what multipliers pay for, as a share of the bound. A
   constraint at its cap violates that by being inside the bound which it pays for. */
static real worst_violation(const gpmpc_program *program)
{
    real least = program->negligible_length;
    real length =
        SQRT(larger(absolute(dot(program->slope, program->value, N)), least * least));
    real worst = 0;
    int p;
    for (p = 0; p < constraint_count(program); p++) {
        real above = program->value[p] - program->upper[p];
        real below = program->lower[p] - program->value[p];
        int at_cap = !(absolute(program->multiplier[p]) < program->cap[p]);
        int at_upper = at_cap ? program->multiplier[p] > 0 : above > below;
        real outside_bound = at_upper ? above : below;
        real beyond = at_cap ? -outside_bound : outside_bound;
        real excess = beyond - program->negligible[p];
        real bound = at_upper ? program->upper[p] : program->lower[p];
        if (excess > 0) /* which that of a constraint without bounds is not */
            worst = larger(worst, excess / larger(length * program->norm[p] / 1000,
                                                  absolute(bound)));
    }
    return worst;
}

/* Starts from a guess: soft rows that stay violated at their caps, then the candidates
   for the working set. Returns how many. */
static int start(gpmpc_program *program, const gpmpc_solution *guess)
{
    int usable = guess->rows == program->rows;
    int p;
    for (p = 0; p < GPMPC_SLOTS; p++)
        program->place[p] = p;
    if (program->soft && usable)
        for (p = N; p < constraint_count(program); p++) {
            real multiplier = guess->multiplier[p];
            real bound = multiplier > 0 ? program->upper[p] : program->lower[p];
            if (absolute(multiplier) >= program->cap[p] && is_finite(bound)) {
                real cap = program->cap[p];
                program->multiplier[p] = multiplier > 0 ? cap : -cap;
                watch(program, p);
            }
        }
    add_multipliers(program, 0);
    for (p = 0; p < N; p++)
        program->free_rhs[p] = -program->slope[p];
    solve_transposed(&program->L[0][0], N, N, program->free_rhs);
    return usable ? choose_guessed(program, guess) : 0;
}

/* What cancellation left of the smallest pivot of K_WW, as a share of K_pp. */
static real least_pivot_share(const gpmpc_program *program, int k)
{
    real share = program->pivot_share;
    int i;
    for (i = 0; i < k; i++) {
        real reciprocal = program->factor[i][i];
        share = smaller(share, 1 / (reciprocal * reciprocal * program->diagonal[i]));
    }
    return share;
}

static void write_solution(const gpmpc_program *program, const Progress *progress,
                           gpmpc_solution *solution)
{
    int i;
    solution->status = progress->status;
    solution->iterations = progress->iterations;
    solution->rows = program->rows;
    solution->working = progress->size;
    copy(program->value, solution->x, N);
    copy(program->value_low, solution->x_low, N);
    solution->violation = 0;
    for (i = 0; i < constraint_count(program); i++)
        solution->violation = larger(solution->violation,
                                     larger(above_bound(program, i),
                                            below_bound(program, i)));
    copy(program->multiplier, solution->multiplier, constraint_count(program));
    for (i = 0; i < progress->size; i++)
        solution->label[i] = program->label[i];
}

/* Solves the opened program in rounds: iterate, refine x on its working set, look for
   violations that are left. */
static void solve_opened(const gpmpc_problem *problem, gpmpc_program *program,
                         const gpmpc_solution *guess, int limit,
                         gpmpc_solution *solution)
{
    Progress progress = {GPMPC_NUMERICAL_TROUBLE, 0, 0, limit, BATCHES, 0};
    real fine = smaller(FINE, GPMPC_TOLERANCE);
    real margin = LATER * program->length_of_q; /* small ones wait for the refined x */
    int first_round = 1;
    int rounds = 0;
    int count = 0;
    int finest = 0; /* whether x is to be as good as can be */
    int guessed = start(program, guess);
    int i;
    if (guess->rows == program->rows && guess->status == GPMPC_ITERATION_LIMIT)
        progress.batches_left = 0;
    for (;;) {
        real pivot_share, largest_residual, tolerance, residual, length = 0;
        if (first_round || count > 0) {
            iterate(program, &progress, first_round, guessed, count, margin);
            if (progress.status != GPMPC_SOLVED)
                break;
        }
        first_round = 0;
        for (i = 0; i < progress.size; i++) /* bounds of variables hold exactly */
            if (constraint_in(program, i) < N) {
                program->value[constraint_in(program, i)] = program->bound[i];
                program->value_low[constraint_in(program, i)] = 0;
            }
        pivot_share = smaller(program->pivot_share,
                              SQRT(least_pivot_share(program, progress.size)));
        finest = finest || progress.passed_over || pivot_share < ILL;
        largest_residual = DOUBT * pivot_share;
        tolerance = smaller(finest ? FINEST : fine, largest_residual);
        residual = refine(problem, program, progress.size, tolerance, &length);
        progress.status = residual <= smaller(GPMPC_TOLERANCE, largest_residual)
                              ? GPMPC_SOLVED
                              : GPMPC_NUMERICAL_TROUBLE;
        rounds++;
        if (rounds == ROUNDS || residual >= UNDEFINED)
            break;
        margin = 0;
        /* the error of x may hide a violation */
        count = list_violated(program, finest ? 0 : -residual * length / pivot_share);
        if (count == 0)
            break;
        if (!finest) { /* refine once more before these are believed */
            finest = 1;
            count = 0;
        }
    }
    if ((progress.passed_over || rounds == ROUNDS) && progress.status == GPMPC_SOLVED
        && worst_violation(program) > NOISE)
        progress.status = GPMPC_NUMERICAL_TROUBLE;
    write_solution(program, &progress, solution);
}

/* Reads the prices of the states' rows, and the program; factorises P. Returns whether
   it is a proper one. */
static int open_program(gpmpc_program *program, const real *prices)
{
    int rows = program->rows;
    int i, j;
    fill(program->cap, INFINITY, N + rows);
    program->soft = GPMPC_SOFT;
    for (i = 0; i < H && GPMPC_SOFT; i++)
        copy(prices, program->cap + N + rows - GPMPC_STATE_ROWS + i * r, r);
    program->pivot_share = factorise(program) ? measure_rows(program) : 0;
    program->length_of_q = 0;
    for (j = 0; j < N; j++) {
        real length = absolute(program->q[j]) * program->norm[j];
        if (!(program->pivot_share > 0) || !is_finite(length))
            return 0;
        program->length_of_q = larger(program->length_of_q, length);
    }
    program->negligible_length = NEGLIGIBLE * program->length_of_q;
    return read_bounds(program);
}

/* The size of the numbers that cancelled in a row of zeros: that of the other bounds,
   but at most one; one where there are no others. */
static real zero_row_size(const gpmpc_program *program)
{
    real size = 0;
    int p;
    for (p = 0; p < constraint_count(program); p++) {
        if (program->row_end[p] == 0)
            continue;
        if (is_finite(program->lower[p]))
            size = larger(size, absolute(program->lower[p]));
        if (is_finite(program->upper[p]))
            size = larger(size, absolute(program->upper[p]));
    }
    return size > 0 ? smaller(1, size) : 1;
}

/* The weight of a constraint in a proof: none where it may be violated for a price. */
static real weight_in_proof(const gpmpc_program *program, const real *ray, int p)
{
    return program->cap[p] < LARGEST ? 0 : ray[p];
}

/* Returns whether the multipliers prove that no x keeps the bounds (Farkas): with
   y'C = 0, up to rounding, sum y+ upper + y- lower < 0. */
static int proves_infeasibility(gpmpc_program *program, const real *ray)
{
    real total = 0;
    real sizes = 0;
    int p;
    for (p = 0; p < constraint_count(program); p++) {
        real repaired = weight_in_proof(program, ray, p);
        real bound;
        if (p < N) {
            real rest = repaired;
            real rounding = absolute(repaired);
            int i;
            for (i = 0; i < program->rows; i++) {
                real weight = weight_in_proof(program, ray, N + i);
                rest += weight * program->G[i][p];
                rounding += absolute(weight * program->G[i][p]);
            }
            if (absolute(rest) > ROUNDING_OF_SUMS * rounding)
                repaired -= rest;
        }
        if (repaired == 0)
            continue;
        bound = repaired > 0 ? program->upper[p] : program->lower[p];
        if (!is_finite(repaired * bound))
            return 0;
        total += repaired * bound;
        sizes += absolute(repaired * bound);
        if (program->row_end[p] == 0)
            sizes += absolute(repaired) * zero_row_size(program);
    }
    return total < -ROUNDING_OF_SUMS * sizes;
}

static int is_certain(gpmpc_program *program, const gpmpc_solution *solution)
{
    if (solution->status == GPMPC_INFEASIBLE)
        return proves_infeasibility(program, solution->multiplier);
    return solution->status == GPMPC_SOLVED
           || (solution->status == GPMPC_ITERATION_LIMIT && GPMPC_ITERATIONS > 0);
}

/*{rescue}*/

/* Solves the program of a problem with prices (r,) of violated rows of the states,
   starting from the solution of a similar one, which may be where the new one is written
   to. A solution that its residuals do not support is tried again from its own working
   set, then with doubled digits. */
static void solve(const gpmpc_problem *problem, gpmpc_program *program,
                  const gpmpc_solution *guess, gpmpc_solution *solution)
{
    int iterations;
    if (!open_program(program, problem->prices)) {
        solution->status = GPMPC_NUMERICAL_TROUBLE;
        solution->rows = -1;
        solution->working = 0;
        fill(solution->x, 0, N);
        return;
    }
    solve_opened(problem, program, guess, changes_left(program, 0), solution);
    if (is_certain(program, solution))
        return;
    iterations = solution->iterations;
    if (read_bounds(program))
        solve_opened(problem, program, solution, changes_left(program, iterations),
                     solution);
    solution->iterations += iterations;
    if (!is_certain(program, solution))
        rescue_solution(problem, program, solution);
}

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
static int changes_left(const gpmpc_program *work, int changes_before)
{
    if (GPMPC_ITERATIONS > 0)
        return GPMPC_ITERATIONS - changes_before;
    return 100 + 10 * (N + work->rows);
}

static int constraint_count(const gpmpc_program *work) { return N + work->rows; }

/* Constraint p of a label p + 1 (at its upper bound) or -(p + 1) (at its lower one). */
static int constraint_of(int label) { return abs(label) - 1; }

static int constraint_in(const gpmpc_program *work, int slot)
{
    return constraint_of(work->label[slot]);
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
static int factorise(gpmpc_program *work)
{
    int i, j;
    for (i = N - 1; i >= 0; i--) {
        real *row = work->L[i];
        real pivot;
        copy(work->P[i], row, i + 1);
        if (i < N - 1)
            add_combination(-1, &work->L[i + 1][i], N, work->L + i + 1, N - 1 - i, row,
                            i + 1);
        pivot = row[i];
        if (!(pivot > N * PIVOT_ROUNDING * work->P[i][i]) || !is_finite(pivot))
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
static real measure_rows(gpmpc_program *work)
{
    real *units = work->scratch;
    real cancelled = 1;
    real undefined = 0;
    int i, j;
    for (i = 0; i < N; i++) {
        units[i] = 1 / SQRT(work->P[i][i]);
        work->norm[i] = units[i];
        work->row_end[i] = i + 1;
        cancelled =
            larger(cancelled, work->L[i][i] * work->L[i][i] * work->P[i][i]);
    }
    for (i = 0; i < work->rows; i++) {
        const real *row = work->G[i];
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
        work->norm[N + i] = norm > 0 ? norm : 1;
        work->row_end[N + i] = end;
    }
    return undefined == 0 ? 1 / cancelled : 0;
}

/* Lets constraint p, outside the working set, count as violated: with a
   multiplier of zero beyond its bounds, at a cap inside the bound that it violates. */
static void watch(gpmpc_program *work, int p)
{
    real low = work->lower[p];
    real high = work->upper[p];
    real below = is_finite(low) ? TOLERATED * absolute(low) : 0;
    real above = is_finite(high) ? TOLERATED * absolute(high) : 0;
    work->allowed_low[p] = low - (below + work->negligible[p]);
    work->allowed_high[p] = high + (above + work->negligible[p]);
    if (work->multiplier[p] > 0) {
        work->allowed_low[p] = high - (above + work->negligible[p]);
        work->allowed_high[p] = INFINITY;
    } else if (work->multiplier[p] < 0) {
        work->allowed_low[p] = -INFINITY;
        work->allowed_high[p] = low + (below + work->negligible[p]);
    }
}

/* Reads the bounds, absent ones as infinite, and clears the multipliers. Returns
   whether none are crossed or undefined. */
static int read_bounds(gpmpc_program *work)
{
    int M = constraint_count(work);
    int p;
    for (p = 0; p < M; p++) {
        real low = work->lower[p];
        real high = work->upper[p];
        if (!(low <= high))
            return 0;
        if (low <= -ABSENT)
            low = -INFINITY;
        if (high >= ABSENT)
            high = INFINITY;
        if (low > LARGEST || high < -LARGEST)
            return 0;
        work->lower[p] = low;
        work->upper[p] = high;
        work->negligible[p] = work->negligible_length * work->norm[p];
        work->multiplier[p] = 0;
        work->multiplier_low[p] = 0;
        watch(work, p);
    }
    return 1;
}

/* Lets constraint p count as satisfied whatever its value: it is in the working set,
   or cannot be told from one that is. */
static void stop_watching(gpmpc_program *work, int p)
{
    work->allowed_low[p] = -INFINITY;
    work->allowed_high[p] = INFINITY;
}

static int is_watched(const gpmpc_program *work, int p)
{
    return work->allowed_low[p] > -LARGEST || work->allowed_high[p] < LARGEST;
}

/* The value of a row of G at the present x. */
static void write_value(gpmpc_program *work, int row)
{
    work->value[N + row] = dot(work->G[row], work->value, work->row_end[N + row]);
    work->value_low[N + row] = 0;
}

static void multiply_constraints(gpmpc_program *work)
{
    int row;
    for (row = 0; row < work->rows; row++)
        write_value(work, row);
}

static real outside(const gpmpc_program *work, int p)
{
    real above = (work->value[p] - work->allowed_high[p])
                 + (work->value_low[p] - work->upper_low[p]);
    real below = (work->allowed_low[p] - work->value[p])
                 + (work->lower_low[p] - work->value_low[p]);
    return larger(above, below);
}

/* Lists the constraints violated by more than a margin, both in units of the norm. */
static int list_violated(gpmpc_program *work, real margin)
{
    int count = 0;
    int p;
    for (p = 0; p < constraint_count(work); p++) {
        real excess = outside(work, p) - margin * work->norm[p];
        if (excess > 0) {
            work->excess[p] = excess / work->norm[p];
            work->violated[count++] = p;
        }
    }
    return count;
}

/* Keeps the listed constraints that are still violated. */
static int recheck_violated(gpmpc_program *work, real margin, int count)
{
    int remaining = 0;
    int i;
    for (i = 0; i < count; i++) {
        int p = work->violated[i];
        if (p >= N)
            write_value(work, p - N);
        work->excess[p] = outside(work, p) / work->norm[p] - margin;
        if (work->excess[p] > 0)
            work->violated[remaining++] = p;
    }
    return remaining;
}

static int most_violated(const gpmpc_program *work, int count)
{
    int worst = work->violated[0];
    int i;
    for (i = 1; i < count; i++)
        if (work->excess[work->violated[i]] > work->excess[worst])
            worst = work->violated[i];
    return worst;
}

/* Makes candidates of the constraints violated nearly as badly as the worst; none
   where only one is. */
static int choose_badly_violated(gpmpc_program *work, real threshold, int count,
                                 int most)
{
    int chosen = 0;
    int bad = 0;
    int i;
    for (i = 0; i < count; i++) {
        int p = work->violated[i];
        if (!(work->excess[p] > threshold))
            continue;
        bad++;
        if (chosen < most && work->multiplier[p] == 0) {
            int at_upper = work->value[p] > work->upper[p];
            work->candidates[chosen++] = at_upper ? p + 1 : -(p + 1);
        }
    }
    return bad > 1 ? chosen : 0;
}

/* Makes candidates of the working set of a guess. */
static int choose_guessed(gpmpc_program *work, const gpmpc_solution *guess)
{
    int chosen = 0;
    int i;
    for (i = 0; i < guess->working; i++) {
        int label = guess->label[i];
        int p = constraint_of(label);
        real bound;
        if (p < 0 || p >= constraint_count(work))
            continue;
        bound = label > 0 ? work->upper[p] : work->lower[p];
        if (work->multiplier[p] == 0 && is_finite(bound))
            work->candidates[chosen++] = label;
    }
    return chosen;
}

/* Writes w_p = L^-T c_p. */
static void write_column(const gpmpc_program *work, int p, real *w)
{
    int end = work->row_end[p];
    fill(w, 0, N);
    if (p < N)
        w[p] = 1;
    else
        copy(work->G[p - N], w, end);
    solve_transposed(&work->L[0][0], N, end, w);
}

/* Writes constraint p, at its upper or its lower bound, to slot k. */
static void write_slot(gpmpc_program *work, int k, int p, int at_upper)
{
    real *w = work->w[work->place[k]];
    int equality = work->lower[p] == work->upper[p];
    real cap = work->cap[p];
    write_column(work, p, w);
    work->diagonal[k] = dot(w, w, work->row_end[p]);
    work->label[k] = at_upper ? p + 1 : -(p + 1);
    work->bound[k] = at_upper ? work->upper[p] : work->lower[p];
    work->least_multiplier[k] = equality || !at_upper ? -cap : 0;
    work->most_multiplier[k] = equality || at_upper ? cap : 0;
    work->free_value[k] = dot(w, work->free_rhs, N);
}

/* Writes L_K^-1 K_Wp, the row that p in slot k would add to the factor. */
static void compute_factor_row(gpmpc_program *work, int k, int p)
{
    const real *w = work->w[work->place[k]];
    int i;
    for (i = 0; i < k; i++)
        work->forward[i] = dot(work->w[work->place[i]], w, work->row_end[p]);
    solve_lower(&work->factor[0][0], GPMPC_SLOTS, k, work->forward);
}

/* target <- target - sum_i factors[i] w_i */
static void subtract_working(const gpmpc_program *work, const real *factors, int k,
                             real *target)
{
    int i;
    for (i = 0; i < k; i++)
        add_scaled(-factors[i], work->w[work->place[i]], target, N);
}

/* d = |w_p - sum r_i w_i|^2, r = direction: as a sum of squares it cannot cancel */
static real distance_to_span(gpmpc_program *work, int k)
{
    copy(work->w[work->place[k]], work->scratch, N);
    subtract_working(work, work->direction, k, work->scratch);
    return dot(work->scratch, work->scratch, N);
}

/* Adds p, in slot k, whose row of the factor is ``forward``; pivot > 0. */
static int add_constraint(gpmpc_program *work, int k, int p, real pivot)
{
    copy(work->forward, work->factor[k], k);
    work->factor[k][k] = 1 / SQRT(pivot);
    stop_watching(work, p);
    return k + 1;
}

/* Adds candidates, but for those that depend on others. */
static int add_candidates(gpmpc_program *work, int k, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        int label = work->candidates[i];
        int p = constraint_of(label);
        real pivot;
        if (!is_watched(work, p) || k >= N)
            continue;
        write_slot(work, k, p, label > 0);
        compute_factor_row(work, k, p);
        pivot = work->diagonal[k] - dot(work->forward, work->forward, k);
        if (pivot > CANDIDATE_PIVOT * work->diagonal[k])
            k = add_constraint(work, k, p, pivot);
    }
    return k;
}

/* Deletes row ``gone`` of the factor of k rows, and its entry of ``forward``, by Givens
   rotations (Golub and Van Loan, Matrix Computations, section 6.5.2). */
static void delete_row(gpmpc_program *work, int k, int gone)
{
    real left = work->forward[gone];
    int i, j;
    for (i = gone + 1; i < k; i++) {
        const real *row = work->factor[i];
        real *above = work->factor[i - 1];
        real rest = row[gone];
        real below = work->forward[i];
        real diagonal, reciprocal;
        copy(row, above, gone);
        for (j = gone + 1; j < i; j++) {
            real entry = row[j];
            above[j - 1] = work->cosines[j] * rest + work->sines[j] * entry;
            rest = work->cosines[j] * entry - work->sines[j] * rest;
        }
        diagonal = 1 / row[i];
        reciprocal = 1 / SQRT(rest * rest + diagonal * diagonal);
        work->cosines[i] = rest * reciprocal;
        work->sines[i] = diagonal * reciprocal;
        above[i - 1] = reciprocal;
        work->forward[i - 1] = work->cosines[i] * left + work->sines[i] * below;
        left = work->cosines[i] * below - work->sines[i] * left;
    }
}

/* Drops the constraint in a slot; those behind it, up to slot k, go one slot down. */
static void drop_constraint(gpmpc_program *work, int k, int slot)
{
    int free_place = work->place[slot];
    int i;
    delete_row(work, k, slot);
    for (i = slot; i < k; i++) {
        work->label[i] = work->label[i + 1];
        work->place[i] = work->place[i + 1];
        work->bound[i] = work->bound[i + 1];
        work->free_value[i] = work->free_value[i + 1];
        work->least_multiplier[i] = work->least_multiplier[i + 1];
        work->most_multiplier[i] = work->most_multiplier[i + 1];
        work->diagonal[i] = work->diagonal[i + 1];
    }
    work->place[k] = free_place;
}

/* slope = q + C'multiplier; only where rows are soft can others than the k working
   ones have a multiplier */
static void add_multipliers(gpmpc_program *work, int k)
{
    int count = work->soft ? work->rows : k;
    int i, j;
    for (j = 0; j < N; j++)
        work->slope[j] = work->q[j] + work->multiplier[j];
    for (i = 0; i < count; i++) {
        int p = work->soft ? N + i : constraint_in(work, i);
        if (p >= N && work->multiplier[p] != 0)
            add_scaled(work->multiplier[p], work->G[p - N], work->slope,
                       work->row_end[p]);
    }
}

/* Writes the minimiser of the Lagrangian, P x = -(q + C'mu). */
static void minimise(gpmpc_program *work, int k)
{
    real *x = work->value;
    int i;
    if (work->soft) { /* constraints at their caps have multipliers, too */
        add_multipliers(work, k);
        for (i = 0; i < N; i++)
            x[i] = -work->slope[i];
        solve_transposed(&work->L[0][0], N, N, x);
    } else { /* L x = free_rhs - sum mu_i w_i */
        copy(work->free_rhs, x, N);
        for (i = 0; i < k; i++)
            work->scratch[i] = work->multiplier[constraint_in(work, i)];
        subtract_working(work, work->scratch, k, x);
    }
    solve_lower(&work->L[0][0], N, N, x);
    fill(work->value_low, 0, N);
}

/* Where the range of a multiplier ends that decreases at this rate. */
static real end_of_range(const gpmpc_program *work, int slot, real rate)
{
    return rate > 0 ? work->least_multiplier[slot] : work->most_multiplier[slot];
}

/* Shortens a step so that it keeps the multipliers in range; returns the slot that ends
   it, or k. A rate r_i that may be rounding blocks nothing. The unit of r_i is that of
   its row, so it is weighed by the length of w_i, whose square is K_ii. */
static int first_blocking(const gpmpc_program *work, int k, real sense, real *step)
{
    real largest_square = 0;
    real rounding;
    int blocking = k;
    int i;
    for (i = 0; i < k; i++) {
        real rate = work->direction[i];
        largest_square = larger(largest_square, rate * rate * work->diagonal[i]);
    }
    rounding = NO_RATE * NO_RATE * largest_square;
    for (i = 0; i < k; i++) {
        real rate = sense * work->direction[i];
        real room;
        if (!(rate * rate * work->diagonal[i] > rounding))
            continue;
        room = (work->multiplier[constraint_in(work, i)]
                - end_of_range(work, i, rate)) / rate;
        if (room < *step) {
            *step = larger(room, 0);
            blocking = i;
        }
    }
    return blocking;
}

/* Moves multipliers until constraint p is satisfied: steps 1 and 2 of algorithm 1.
   Returns whether it does not contradict the working ones. */
static int satisfy_constraint(gpmpc_program *work, int *size, int p, int *changes)
{
    real *mu = work->multiplier;
    int k = *size;
    int at_upper;
    real sense, violation;
    if (mu[p] == 0) {
        at_upper = work->value[p] > work->upper[p];
        sense = at_upper ? 1 : -1; /* the direction in which mu_p moves */
    } else { /* it comes back from a cap: p holds, and need not be paid for */
        at_upper = mu[p] > 0;
        sense = at_upper ? -1 : 1;
    }
    write_slot(work, k, p, at_upper);
    compute_factor_row(work, k, p);
    violation = sense * (at_upper ? above_bound(work, p) : -below_bound(work, p));
    for (;;) {
        real K_pp = work->diagonal[k];
        real d, step, room, range_end;
        int reaches_range_end, blocking, i;
        /* direction: r = K_WW^-1 K_Wp, d = K_pp - K_pW r */
        copy(work->forward, work->direction, k);
        solve_transposed(&work->factor[0][0], GPMPC_SLOTS, k, work->direction);
        d = K_pp - dot(work->forward, work->forward, k);
        if (d < DOUBTFUL_SQUARE * K_pp)
            d = distance_to_span(work, k);
        /* length: until p holds, its multiplier is at the end of its range (its cap, or
           zero on the way back), or a working one is */
        step = d > DEPENDENT_SQUARE * K_pp && k < N ? larger(0, violation) / d
                                                    : INFINITY;
        range_end = sense > 0 ? work->most_multiplier[k] : work->least_multiplier[k];
        room = (range_end - mu[p]) * sense;
        reaches_range_end = room < step;
        if (reaches_range_end)
            step = room;
        blocking = first_blocking(work, k, sense, &step);
        if (step > LARGEST) { /* (r, -1) is Farkas' proof, unless rounding violates p */
            *size = k;
            return 0;
        }
        for (i = 0; i < k; i++)
            mu[constraint_in(work, i)] -= sense * step * work->direction[i];
        mu[p] += sense * step;
        (*changes)++;
        if (blocking < k) { /* partial step: drop what blocks, and try p again */
            int leaving = constraint_in(work, blocking);
            mu[leaving] = end_of_range(work, blocking,
                                       sense * work->direction[blocking]);
            drop_constraint(work, k, blocking);
            k--;
            watch(work, leaving);
            violation -= step * d;
        } else if (reaches_range_end) { /* stays violated at its cap, or holds */
            mu[p] = range_end;
            watch(work, p);
            *size = k;
            return 1;
        } else { /* full step: add p */
            *size = add_constraint(work, k, p, d);
            return 1;
        }
    }
}

/* sum |r_i b_i|, of which the value of the combination sum r_i c_i is made */
static real terms_of_combination(const gpmpc_program *work, int k)
{
    real terms = 0;
    int i;
    for (i = 0; i < k; i++)
        terms += absolute(work->direction[i] * work->bound[i]);
    return terms;
}

/* Whether p contradicts the working set by more than rounding. */
static int is_contradiction(const gpmpc_program *work, int p, real terms)
{
    real size = larger(larger(absolute(work->value[p]), terms),
                       work->length_of_q * work->norm[p]);
    return work->excess[p] * work->norm[p] > HOPELESS * size;
}

/* Writes Farkas' proof that p contradicts the working set to the multipliers. */
static void write_ray(gpmpc_program *work, int k, int p)
{
    real sense = work->value[p] > work->upper[p] ? 1 : -1;
    int i;
    fill(work->multiplier, 0, constraint_count(work));
    for (i = 0; i < k; i++) {
        int constraint = constraint_in(work, i);
        real ray = -sense * work->direction[i];
        if (ray * (real)work->label[i] >= 0
            || work->lower[constraint] == work->upper[constraint])
            work->multiplier[constraint] = ray;
    }
    work->multiplier[p] = sense;
}

/* Solves K_WW mu = y_W - b_W; drops the most wrong one until all are in range. */
static int drop_wrong_multipliers(gpmpc_program *work, int k)
{
    real *trial = work->direction;
    int i;
    for (i = 0; i < k; i++)
        work->forward[i] = work->free_value[i] - work->bound[i];
    solve_lower(&work->factor[0][0], GPMPC_SLOTS, k, work->forward);
    for (;;) {
        real worst = 0;
        int slot = k;
        int p;
        copy(work->forward, trial, k);
        solve_transposed(&work->factor[0][0], GPMPC_SLOTS, k, trial);
        for (i = 0; i < k; i++) {
            real beyond = larger(trial[i] - work->most_multiplier[i],
                                 work->least_multiplier[i] - trial[i]);
            if (beyond > worst) {
                worst = beyond;
                slot = i;
            }
        }
        if (slot == k)
            break;
        p = constraint_in(work, slot);
        drop_constraint(work, k, slot);
        k--;
        work->multiplier[p] = 0;
        watch(work, p);
    }
    for (i = 0; i < k; i++)
        work->multiplier[constraint_in(work, i)] = trial[i];
    return k;
}

static void clip_multiplier(gpmpc_program *work, int slot, real value)
{
    work->multiplier[constraint_in(work, slot)] =
        smaller(larger(value, work->least_multiplier[slot]),
                work->most_multiplier[slot]);
}

/* Puts the working multipliers into their ranges, which rounding can leave. */
static void clip_multipliers(gpmpc_program *work, int k)
{
    int i;
    for (i = 0; i < k; i++)
        clip_multiplier(work, i, work->multiplier[constraint_in(work, i)]);
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
static void iterate(gpmpc_program *work, Progress *progress, int starts, int guessed,
                    int count, real margin)
{
    int candidates = guessed;
    int all_listed = 1; /* whether the list was made of all constraints */
    int k = progress->size;
    int violated = 0;
    fill(work->multiplier_low, 0, constraint_count(work));
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
            p = most_violated(work, count);
            candidates = 0;
            if (all_listed && progress->batches_left > 0) {
                candidates = choose_badly_violated(work, work->excess[p] / 2, count,
                                                   N - k);
                progress->batches_left -= candidates > 0;
            }
        }
        k = add_candidates(work, k, candidates);
        single = !starts && k == size_before;
        if (single) {
            real multiplier_before = work->multiplier[p];
            int satisfied =
                satisfy_constraint(work, &k, p, &progress->iterations);
            multipliers_fit = 1;
            if (!satisfied) {
                real terms = terms_of_combination(work, k);
                if (is_contradiction(work, p, terms)) {
                    write_ray(work, k, p);
                    progress->status = GPMPC_INFEASIBLE;
                    break;
                }
                /* pass p over: it contradicts the others by rounding */
                work->multiplier[p] = multiplier_before;
                work->negligible[p] += ROUNDING_OF_BOUNDS * terms;
                stop_watching(work, p);
                progress->passed_over = 1;
                multipliers_fit = work->soft;
            }
            if (work->soft)
                progress->batches_left = 0;
        } else if (!starts) {
            progress->iterations += k - size_before;
        }
        if (!multipliers_fit)
            k = drop_wrong_multipliers(work, k);
        minimise(work, k);
        /* first satisfy those that were seen to be violated, then look at all */
        look_at_all = count == 1 || work->soft
                      || progress->iterations >= progress->limit;
        all_listed = look_at_all || !single;
        if (!all_listed) {
            count = recheck_violated(work, margin, count);
            all_listed = count == 0;
        }
        if (all_listed) {
            multiply_constraints(work);
            count = list_violated(work, margin);
        }
        starts = 0;
    }
    if (progress->status == GPMPC_SOLVED && violated)
        clip_multipliers(work, k);
    progress->size = k;
}

/* A working constraint's residual by x, or a hundredth by its own terms. */
static real relative_residual(const gpmpc_program *work, int slot, real residual,
                              real length)
{
    int p = constraint_in(work, slot);
    real scaled_length = length * work->norm[p];
    real terms;
    if (!(residual > FINEST * scaled_length))
        return 0;
    terms = larger(absolute(work->bound[slot]), REAL(1e-6) * scaled_length);
    if (p >= N && residual > ROW_RESIDUAL * terms) {
        int j;
        for (j = 0; j < work->row_end[p]; j++)
            terms = larger(terms, absolute(work->G[p - N][j] * work->value[j]));
    }
    return larger(residual / scaled_length, residual / (100 * terms));
}

/* Writes the gradient of the Lagrangian by x, and returns the square of the length of
   x; in float the values of rows are written, too. */
static real write_lagrangian(const gpmpc_problem *problem, gpmpc_program *work)
{
    const real *x = work->value;
    real square;
#if GPMPC_IS_FLOAT
    multiply(&work->P[0][0], x, N, N, work->scratch);
    square = dot(work->scratch, x, N);
    evaluate_along_dynamics(problem, work);
#else
    (void)problem;
    multiply(&work->P[0][0], x, N, N, work->gradient);
    square = dot(work->gradient, x, N);
    add_scaled(1, work->slope, work->gradient, N);
#endif
    return square;
}

/* How far a working constraint is above its bound. */
static real slot_residual(const gpmpc_program *work, int slot)
{
    int p = constraint_in(work, slot);
    return work->label[slot] > 0 ? above_bound(work, p) : -below_bound(work, p);
}

/* Returns the residual of x on the working set as a share of the length of x, UNDEFINED
   where a number is not finite; writes the length. */
static real measure_residual(const gpmpc_problem *problem, gpmpc_program *work, int k,
                             real *length)
{
    const real *x = work->value;
    real least = work->negligible_length;
    real steps = 0;
    real shifts = 0;
    real entries = TINY;
    real undefined = 0;
    real worst;
    int i, j;
    real square = write_lagrangian(problem, work);
    *length = SQRT(larger(larger(square, least * least), TINY));
    for (j = 0; j < N; j++) {
        real step = absolute(work->gradient[j]) * work->norm[j];
        steps = larger(steps, step);
        shifts = larger(shifts, step * work->norm[j]);
        entries = larger(entries, absolute(x[j]));
        undefined += 0 * step;
    }
    worst = larger(steps / *length, shifts / (100 * entries));
    for (i = 0; i < k; i++) {
        real residual = slot_residual(work, i);
        work->residual[i] = residual;
        worst = larger(worst, relative_residual(work, i, absolute(residual), *length));
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
static void take_newton_step(gpmpc_program *work, int k)
{
    real *transformed = work->scratch; /* L^-T gradient */
    real *dmu = work->direction;       /* K_WW^-1 (residual - W transformed) */
    real *dx = work->gradient;         /* -L^-1 (transformed + sum dmu_i w_i) */
    int i;
    copy(work->gradient, transformed, N);
    solve_transposed(&work->L[0][0], N, N, transformed);
    for (i = 0; i < k; i++)
        dmu[i] = work->residual[i] - dot(work->w[work->place[i]], transformed, N);
    solve_lower(&work->factor[0][0], GPMPC_SLOTS, k, dmu);
    solve_transposed(&work->factor[0][0], GPMPC_SLOTS, k, dmu);
    for (i = 0; i < N; i++)
        dx[i] = -transformed[i];
    subtract_working(work, dmu, k, dx);
    solve_lower(&work->L[0][0], N, N, dx);
    for (i = 0; i < N; i++)
        correct(work->value, work->value_low, i, dx[i]);
    for (i = 0; i < k; i++) {
        int p = constraint_in(work, i);
        real unclipped;
        correct(work->multiplier, work->multiplier_low, p, dmu[i]);
        unclipped = work->multiplier[p];
        clip_multiplier(work, i, unclipped);
        if (work->multiplier[p] != unclipped)
            work->multiplier_low[p] = 0;
    }
    if (!GPMPC_IS_FLOAT) /* there values come with the residuals */
        multiply_constraints(work);
}

/* Corrects x and the multipliers on the working set until their residual is small, or
   does not halve any more. Returns the residual. */
static real refine(const gpmpc_problem *problem, gpmpc_program *work, int k,
                   real tolerance, real *length)
{
    real best = INFINITY;
    real residual = INFINITY;
    int step;
    for (step = 0; step <= REFINEMENTS; step++) {
        add_multipliers(work, k);
        residual = measure_residual(problem, work, k, length);
        if (residual <= tolerance || step == REFINEMENTS || !(residual < best / 2))
            break;
        best = residual;
        take_newton_step(work, k);
    }
    return residual;
}

/* The largest violation beyond what multipliers pay for, as a share of the bound. A
   constraint at its cap violates that by being inside the bound which it pays for. */
static real worst_violation(const gpmpc_program *work)
{
    real least = work->negligible_length;
    real length =
        SQRT(larger(absolute(dot(work->slope, work->value, N)), least * least));
    real worst = 0;
    int p;
    for (p = 0; p < constraint_count(work); p++) {
        real above = work->value[p] - work->upper[p];
        real below = work->lower[p] - work->value[p];
        int at_cap = !(absolute(work->multiplier[p]) < work->cap[p]);
        int at_upper = at_cap ? work->multiplier[p] > 0 : above > below;
        real outside_bound = at_upper ? above : below;
        real excess = (at_cap ? -outside_bound : outside_bound) - work->negligible[p];
        real bound = at_upper ? work->upper[p] : work->lower[p];
        if (excess > 0) /* which that of a constraint without bounds is not */
            worst = larger(worst, excess / larger(length * work->norm[p] / 1000,
                                                  absolute(bound)));
    }
    return worst;
}

/* Starts from a guess: soft rows that stay violated at their caps, then the candidates
   for the working set. Returns how many. */
static int start(gpmpc_program *work, const gpmpc_solution *guess)
{
    int usable = guess->rows == work->rows;
    int p;
    for (p = 0; p < GPMPC_SLOTS; p++)
        work->place[p] = p;
    if (work->soft && usable)
        for (p = N; p < constraint_count(work); p++) {
            real multiplier = guess->multiplier[p];
            real bound = multiplier > 0 ? work->upper[p] : work->lower[p];
            if (absolute(multiplier) >= work->cap[p] && is_finite(bound)) {
                work->multiplier[p] = multiplier > 0 ? work->cap[p] : -work->cap[p];
                watch(work, p);
            }
        }
    add_multipliers(work, 0);
    for (p = 0; p < N; p++)
        work->free_rhs[p] = -work->slope[p];
    solve_transposed(&work->L[0][0], N, N, work->free_rhs);
    return usable ? choose_guessed(work, guess) : 0;
}

/* What cancellation left of the smallest pivot of K_WW, as a share of K_pp. */
static real least_pivot_share(const gpmpc_program *work, int k)
{
    real share = work->pivot_share;
    int i;
    for (i = 0; i < k; i++) {
        real reciprocal = work->factor[i][i];
        share = smaller(share, 1 / (reciprocal * reciprocal * work->diagonal[i]));
    }
    return share;
}

static void write_solution(const gpmpc_program *work, const Progress *progress,
                           gpmpc_solution *solution)
{
    int i;
    solution->status = progress->status;
    solution->iterations = progress->iterations;
    solution->rows = work->rows;
    solution->working = progress->size;
    copy(work->value, solution->x, N);
    copy(work->value_low, solution->x_low, N);
    solution->violation = 0;
    for (i = 0; i < constraint_count(work); i++)
        solution->violation = larger(solution->violation,
                                     larger(above_bound(work, i),
                                            below_bound(work, i)));
    copy(work->multiplier, solution->multiplier, constraint_count(work));
    for (i = 0; i < progress->size; i++)
        solution->label[i] = work->label[i];
}

/* Solves the opened program in rounds: iterate, refine x on its working set, look for
   violations that are left. */
static void solve_opened(const gpmpc_problem *problem, gpmpc_program *work,
                         const gpmpc_solution *guess, int limit,
                         gpmpc_solution *solution)
{
    Progress progress = {GPMPC_NUMERICAL_TROUBLE, 0, 0, limit, BATCHES, 0};
    real fine = smaller(FINE, GPMPC_TOLERANCE);
    real margin = LATER * work->length_of_q; /* small ones wait for the refined x */
    int first_round = 1;
    int rounds = 0;
    int count = 0;
    int finest = 0; /* whether x is to be as good as can be */
    int guessed = start(work, guess);
    int i;
    if (guess->rows == work->rows && guess->status == GPMPC_ITERATION_LIMIT)
        progress.batches_left = 0;
    for (;;) {
        real pivot_share, largest_residual, tolerance, residual, length = 0;
        if (first_round || count > 0) {
            iterate(work, &progress, first_round, guessed, count, margin);
            if (progress.status != GPMPC_SOLVED)
                break;
        }
        first_round = 0;
        for (i = 0; i < progress.size; i++) /* bounds of variables hold exactly */
            if (constraint_in(work, i) < N) {
                work->value[constraint_in(work, i)] = work->bound[i];
                work->value_low[constraint_in(work, i)] = 0;
            }
        pivot_share = smaller(work->pivot_share,
                              SQRT(least_pivot_share(work, progress.size)));
        finest = finest || progress.passed_over || pivot_share < ILL;
        largest_residual = DOUBT * pivot_share;
        tolerance = smaller(finest ? FINEST : fine, largest_residual);
        residual = refine(problem, work, progress.size, tolerance, &length);
        progress.status = residual <= smaller(GPMPC_TOLERANCE, largest_residual)
                              ? GPMPC_SOLVED
                              : GPMPC_NUMERICAL_TROUBLE;
        rounds++;
        if (rounds == ROUNDS || residual >= UNDEFINED)
            break;
        margin = 0;
        /* the error of x may hide a violation */
        count = list_violated(work, finest ? 0 : -residual * length / pivot_share);
        if (count == 0)
            break;
        if (!finest) { /* refine once more before these are believed */
            finest = 1;
            count = 0;
        }
    }
    if ((progress.passed_over || rounds == ROUNDS) && progress.status == GPMPC_SOLVED
        && worst_violation(work) > NOISE)
        progress.status = GPMPC_NUMERICAL_TROUBLE;
    write_solution(work, &progress, solution);
}

/* Reads the prices of the states' rows, and the program; factorises P. Returns whether
   it is a proper one. */
static int open_program(gpmpc_program *work, const real *prices)
{
    int rows = work->rows;
    int i, j;
    fill(work->cap, INFINITY, N + rows);
    work->soft = GPMPC_SOFT;
    for (i = 0; i < H && GPMPC_SOFT; i++)
        copy(prices, work->cap + N + rows - GPMPC_STATE_ROWS + i * r, r);
    work->pivot_share = factorise(work) ? measure_rows(work) : 0;
    work->length_of_q = 0;
    for (j = 0; j < N; j++) {
        real length = absolute(work->q[j]) * work->norm[j];
        if (!(work->pivot_share > 0) || !is_finite(length))
            return 0;
        work->length_of_q = larger(work->length_of_q, length);
    }
    work->negligible_length = NEGLIGIBLE * work->length_of_q;
    return read_bounds(work);
}

/* The size of the numbers that cancelled in a row of zeros: that of the other bounds,
   but at most one; one where there are no others. */
static real zero_row_size(const gpmpc_program *work)
{
    real size = 0;
    int p;
    for (p = 0; p < constraint_count(work); p++) {
        if (work->row_end[p] == 0)
            continue;
        if (is_finite(work->lower[p]))
            size = larger(size, absolute(work->lower[p]));
        if (is_finite(work->upper[p]))
            size = larger(size, absolute(work->upper[p]));
    }
    return size > 0 ? smaller(1, size) : 1;
}

/* The weight of a constraint in a proof: none where it may be violated for a price. */
static real weight_in_proof(const gpmpc_program *work, const real *ray, int p)
{
    return work->cap[p] < LARGEST ? 0 : ray[p];
}

/* Returns whether the multipliers prove that no x keeps the bounds (Farkas): with
   y'C = 0, up to rounding, sum y+ upper + y- lower < 0. */
static int proves_infeasibility(gpmpc_program *work, const real *ray)
{
    real total = 0;
    real sizes = 0;
    int p;
    for (p = 0; p < constraint_count(work); p++) {
        real repaired = weight_in_proof(work, ray, p);
        real bound;
        if (p < N) {
            real rest = repaired;
            real rounding = absolute(repaired);
            int i;
            for (i = 0; i < work->rows; i++) {
                real weight = weight_in_proof(work, ray, N + i);
                rest += weight * work->G[i][p];
                rounding += absolute(weight * work->G[i][p]);
            }
            if (absolute(rest) > ROUNDING_OF_SUMS * rounding)
                repaired -= rest;
        }
        if (repaired == 0)
            continue;
        bound = repaired > 0 ? work->upper[p] : work->lower[p];
        if (!is_finite(repaired * bound))
            return 0;
        total += repaired * bound;
        sizes += absolute(repaired * bound);
        if (work->row_end[p] == 0)
            sizes += absolute(repaired) * zero_row_size(work);
    }
    return total < -ROUNDING_OF_SUMS * sizes;
}

static int is_certain(gpmpc_program *work, const gpmpc_solution *solution)
{
    if (solution->status == GPMPC_INFEASIBLE)
        return proves_infeasibility(work, solution->multiplier);
    return solution->status == GPMPC_SOLVED
           || (solution->status == GPMPC_ITERATION_LIMIT && GPMPC_ITERATIONS > 0);
}

/*{rescue}*/

/* Solves the program of a problem with prices (r,) of violated rows of the states,
   starting from the solution of a similar one, which may be where the new one is written
   to. A solution that its residuals do not support is tried again from its own working
   set, then with doubled digits. */
static void solve(const gpmpc_problem *problem, gpmpc_program *work,
                  const gpmpc_solution *guess, gpmpc_solution *solution)
{
    int iterations;
    if (!open_program(work, problem->prices)) {
        solution->status = GPMPC_NUMERICAL_TROUBLE;
        solution->rows = -1;
        solution->working = 0;
        fill(solution->x, 0, N);
        return;
    }
    solve_opened(problem, work, guess, changes_left(work, 0), solution);
    if (is_certain(work, solution))
        return;
    iterations = solution->iterations;
    if (read_bounds(work))
        solve_opened(problem, work, solution, changes_left(work, iterations), solution);
    solution->iterations += iterations;
    if (!is_certain(work, solution))
        rescue_solution(problem, work, solution);
}

/* ------------------------------------------------------------------------------------
   The dual active set once more, for programs that the working digits cannot decide, as
   in gpmpc/qp/_dual_rescue.py: the columns L^-T c_p of the working set have a QR factor
   that is computed anew at each change (Q in ``w``, by rows; R in ``factor``), and x
   and the multipliers have doubled digits, which Newton's method corrects by residuals
   of doubled digits.
   --------------------------------------------------------------------------------- */

enum { CORRECTIONS = 12, DISTANCES = 4 };

enum { OUTSIDE, WORKING, PASSED_OVER }; /* whether a constraint is in the set */

typedef struct {
    const gpmpc_problem *problem; /* NULL: residuals by P and G */
    real dependent; /* distance from the others, as a share, where rows depend on them */
    int size;       /* k, of the working set */
    int iterations;
    char membership[GPMPC_CONSTRAINTS];
    real length[GPMPC_CONSTRAINTS]; /* of the columns */
} Rescue;

/* A violated constraint. */
typedef struct {
    int p;
    int side;  /* 1: the upper bound, -1: the lower one */
    int sense; /* the direction in which the multiplier moves */
    real amount;
} Violation;

/* Writes values and the gradient of the Lagrangian, with doubled digits. */
static void evaluate(const Rescue *rescue, gpmpc_program *program)
{
#if GPMPC_IS_FLOAT
    if (rescue->problem) {
        evaluate_along_dynamics(rescue->problem, program);
        return;
    }
#endif
    (void)rescue;
    evaluate_program(program);
}

/* Takes what lies along the first k columns of Q off a column; twice is enough. Writes
   their shares, and returns the length that is left. */
static real orthogonalise(const gpmpc_program *program, int k, real *column,
                          real *shares)
{
    int pass, i;
    fill(shares, 0, k);
    for (pass = 0; pass < 2; pass++)
        for (i = 0; i < k; i++) {
            real share = dot(program->w[i], column, N);
            add_scaled(-share, program->w[i], column, N);
            shares[i] += share;
        }
    return SQRT(dot(column, column, N));
}

/* Appends constraint p to the factor of k columns; returns how far it is from them. */
static real append_column(gpmpc_program *program, int k, int p)
{
    real *column = program->w[k];
    real distance;
    int i;
    write_column(program, p, column);
    distance = orthogonalise(program, k, column, program->forward);
    for (i = 0; i < k; i++)
        program->factor[i][k] = program->forward[i];
    program->factor[k][k] = distance;
    for (i = 0; i < N; i++)
        column[i] /= distance;
    return distance;
}

static void factorise_working(const Rescue *rescue, gpmpc_program *program)
{
    int i;
    for (i = 0; i < rescue->size; i++)
        (void)append_column(program, i, constraint_in(program, i));
}

/* a <- R^-1 a */
static void solve_upper(const gpmpc_program *program, int k, real *a)
{
    int i, j;
    for (i = k - 1; i >= 0; i--) {
        for (j = i + 1; j < k; j++)
            a[i] -= program->factor[i][j] * a[j];
        a[i] /= program->factor[i][i];
    }
}

/* a <- R^-T a */
static void solve_upper_transposed(const gpmpc_program *program, int k, real *a)
{
    int i, j;
    for (i = 0; i < k; i++) {
        for (j = 0; j < i; j++)
            a[i] -= program->factor[j][i] * a[j];
        a[i] /= program->factor[i][i];
    }
}

/* The range of the multiplier of constraint p at its upper (1) or lower (-1) bound. */
static real least_of(const gpmpc_program *program, int p, int side)
{
    return program->lower[p] == program->upper[p] || side < 0 ? -program->cap[p] : 0;
}

static real most_of(const gpmpc_program *program, int p, int side)
{
    return program->lower[p] == program->upper[p] || side > 0 ? program->cap[p] : 0;
}

static int side_in(const gpmpc_program *program, int slot)
{
    return program->label[slot] > 0 ? 1 : -1;
}

static void set_multiplier(gpmpc_program *program, int p, real multiplier)
{
    program->multiplier[p] = multiplier;
    program->multiplier_low[p] = 0;
}

static void add_working(Rescue *rescue, gpmpc_program *program, int p, int side)
{
    program->label[rescue->size++] = side * (p + 1);
    rescue->membership[p] = WORKING;
}

static void drop_working(Rescue *rescue, gpmpc_program *program, int slot,
                         real multiplier)
{
    int p = constraint_in(program, slot);
    int i;
    set_multiplier(program, p, multiplier);
    rescue->membership[p] = OUTSIDE;
    rescue->size--;
    for (i = slot; i < rescue->size; i++)
        program->label[i] = program->label[i + 1];
    rescue->iterations++;
}

/* Starts with the guessed labels, in ``candidates``, that are far from each other: the
   farthest from the others first. */
static void start_rescue(Rescue *rescue, gpmpc_program *program, int guessed)
{
    int i;
    rescue->size = 0;
    rescue->iterations = 0;
    for (i = 0; i < constraint_count(program); i++) {
        rescue->membership[i] = OUTSIDE;
        set_multiplier(program, i, 0);
        program->value[i] = 0;
        program->value_low[i] = 0;
    }
    while (rescue->size < N) {
        int k = rescue->size;
        real farthest = GUESS_MARGIN * rescue->dependent;
        int best = 0;
        for (i = 0; i < guessed; i++) {
            int label = program->candidates[i];
            int p = constraint_of(label);
            real distance;
            real bound = label > 0 ? program->upper[p] : program->lower[p];
            if (rescue->membership[p] != OUTSIDE || !is_finite(bound)
                || !(rescue->length[p] > 0))
                continue;
            write_column(program, p, program->w[k]);
            distance = orthogonalise(program, k, program->w[k], program->forward);
            if (distance > farthest * rescue->length[p]) {
                farthest = distance / rescue->length[p];
                best = label;
            }
        }
        if (!best)
            break;
        (void)append_column(program, k, constraint_of(best));
        add_working(rescue, program, constraint_of(best), best > 0 ? 1 : -1);
    }
}

/* Adds the Newton step of the residuals to x and the working multipliers:
   a = -A_W dmu - L^-T r1, A_W'a = -r2, L dx = a. Returns the length of the step. */
static real take_accurate_step(Rescue *rescue, gpmpc_program *program)
{
    int k = rescue->size;
    real *a = program->scratch;
    real *change = program->direction; /* of the multipliers */
    real longest = 0;
    int i;
    evaluate(rescue, program);
    copy(program->gradient, a, N);
    solve_transposed(&program->L[0][0], N, N, a);
    for (i = 0; i < k; i++) {
        int p = constraint_in(program, i);
        change[i] = -below_bound(program, p);
        if (side_in(program, i) > 0)
            change[i] = above_bound(program, p);
    }
    solve_upper_transposed(program, k, change);
    for (i = 0; i < N; i++)
        a[i] = -a[i];
    for (i = 0; i < k; i++)
        change[i] += dot(program->w[i], a, N);
    for (i = 0; i < k; i++)
        add_scaled(-change[i], program->w[i], a, N);
    solve_lower(&program->L[0][0], N, N, a);
    solve_upper(program, k, change);
    for (i = 0; i < N; i++) {
        longest = larger(longest, absolute(a[i]) / program->norm[i]);
        add_to(program->value, program->value_low, i, a[i]);
    }
    for (i = 0; i < k; i++)
        add_to(program->multiplier, program->multiplier_low, constraint_in(program, i),
               change[i]);
    return longest;
}

/* Finds x and the multipliers of the working set. Returns whether that converges. */
static int refine_accurately(Rescue *rescue, gpmpc_program *program)
{
    int step, i;
    for (step = 0; step < CORRECTIONS; step++) {
        real longest = take_accurate_step(rescue, program);
        real size = program->negligible_length;
        for (i = 0; i < N; i++)
            size = larger(size, absolute(program->value[i]) / program->norm[i]);
        if (!is_finite(size) || !is_finite(longest))
            return 0;
        if (longest > CONVERGED * size)
            continue;
        for (i = 0; i < rescue->size; i++) { /* bounds of variables hold exactly */
            int p = constraint_in(program, i);
            if (p < N) {
                program->value[p] =
                    side_in(program, i) > 0 ? program->upper[p] : program->lower[p];
                program->value_low[p] = 0;
            }
        }
        return 1;
    }
    return 0;
}

/* Finds x and the multipliers, dropping the most wrong one until all are in range. */
static int correct_multipliers(Rescue *rescue, gpmpc_program *program)
{
    for (;;) {
        real worst = 0;
        real end = 0;
        int wrong = -1;
        int i;
        factorise_working(rescue, program);
        if (!refine_accurately(rescue, program))
            return 0;
        for (i = 0; i < rescue->size; i++) {
            int p = constraint_in(program, i);
            real mu = program->multiplier[p];
            real least = least_of(program, p, side_in(program, i));
            real most = most_of(program, p, side_in(program, i));
            real beyond = larger(mu - most, least - mu) * rescue->length[p];
            if (beyond > worst) {
                worst = beyond;
                wrong = i;
                end = mu > most ? most : least;
            }
        }
        if (wrong < 0)
            return 1;
        drop_working(rescue, program, wrong, is_finite(end) ? end : 0);
    }
}

/* sum |c_pj x_j|, of which the value of constraint p is made */
static real terms_of(const gpmpc_program *program, int p)
{
    real terms = 0;
    int row = p - N;
    int j;
    if (row < 0)
        return absolute(program->value[p]);
    for (j = 0; j < N; j++)
        terms += absolute(program->G[row][j] * program->value[j]);
    return terms;
}

/* The size of the numbers whose rounding a violation may be. */
static real rounded_terms_of(const gpmpc_program *program, int p, int side)
{
    real bound = side > 0 ? program->upper[p] : program->lower[p];
    if (program->row_end[p] == 0)
        return zero_row_size(program);
    return larger(terms_of(program, p), absolute(bound));
}

/* Finds the most violated constraint. Returns whether there is one. */
static int find_violation(const Rescue *rescue, gpmpc_program *program,
                          Violation *violation)
{
    real worst = 0;
    int p;
    evaluate(rescue, program);
    violation->p = -1;
    violation->side = 0;
    violation->sense = 0;
    violation->amount = 0;
    for (p = 0; p < constraint_count(program); p++) {
        real mu = program->multiplier[p];
        real above = is_finite(program->upper[p]) ? above_bound(program, p) : -INFINITY;
        real below = is_finite(program->lower[p]) ? below_bound(program, p) : -INFINITY;
        real excess, terms, share;
        if (rescue->membership[p] != OUTSIDE)
            continue;
        excess = larger(above, below);
        if (mu != 0) /* one at a cap must stay outside its bound */
            excess = mu > 0 ? -above : -below;
        if (!(excess > 0))
            continue;
        terms = larger(terms_of(program, p), absolute(program->value[p] + excess));
        if (!(excess > UNNOTICED * terms))
            continue;
        excess -= NEGLIGIBLE * larger(terms, program->length_of_q * program->norm[p]);
        share = excess / (rescue->length[p] > 0 ? rescue->length[p] : 1);
        if (!(share > worst))
            continue;
        worst = share;
        violation->p = p;
        violation->amount = excess;
        violation->side = above > below ? 1 : -1;
        violation->sense = violation->side;
        if (mu != 0) {
            violation->side = mu > 0 ? 1 : -1;
            violation->sense = -violation->side;
        }
    }
    return violation->p >= 0;
}

/* Finds the longest step up to ``*step`` that keeps the working multipliers, which
   decrease at rates sense r, in range. Returns the slot that ends it, or -1. */
static int first_to_block(const Rescue *rescue, const gpmpc_program *program, int sense,
                          real *step)
{
    real largest = 0;
    int blocking = -1;
    int i;
    for (i = 0; i < rescue->size; i++)
        largest = larger(largest, absolute(program->direction[i])
                                      * rescue->length[constraint_in(program, i)]);
    for (i = 0; i < rescue->size; i++) {
        int p = constraint_in(program, i);
        real rate = (real)sense * program->direction[i];
        real end, room;
        if (!(absolute(rate) * rescue->length[p] > ROUNDING_OF_DATA * largest))
            continue;
        end = rate > 0 ? least_of(program, p, side_in(program, i))
                       : most_of(program, p, side_in(program, i));
        room = larger(0, (program->multiplier[p] - end) / rate);
        if (room < *step) {
            *step = room;
            blocking = i;
        }
    }
    return blocking;
}

/* Moves multipliers until a constraint is satisfied. Returns 0 where it cannot be, or
   is violated by no more than ``rounding``: ``direction`` is then the combination of
   working ones that it is. */
static int satisfy_accurately(Rescue *rescue, gpmpc_program *program,
                              const Violation *violation, real rounding)
{
    int p = violation->p;
    int side = violation->side;
    real sense = (real)violation->sense;
    real amount = violation->amount;
    real multiplier_before = program->multiplier[p];
    for (;;) {
        int k = rescue->size;
        real distance, square, step, range_end, room;
        int independent, reaches_range_end, blocking, i;
        factorise_working(rescue, program);
        write_column(program, p, program->w[k]);
        distance = orthogonalise(program, k, program->w[k], program->direction);
        solve_upper(program, k, program->direction);
        square = distance * distance;
        independent = k < N && distance > rescue->dependent * rescue->length[p];
        step = independent ? amount / square : INFINITY;
        range_end = sense > 0 ? most_of(program, p, side) : least_of(program, p, side);
        room = (range_end - program->multiplier[p]) * sense;
        reaches_range_end = room < step;
        step = smaller(step, room);
        blocking = first_to_block(rescue, program, violation->sense, &step);
        if (step > LARGEST || (!independent && amount <= rounding)) {
            set_multiplier(program, p, multiplier_before);
            return 0;
        }
        for (i = 0; i < k; i++) {
            int w = constraint_in(program, i);
            set_multiplier(program, w,
                           program->multiplier[w]
                               - sense * step * program->direction[i]);
        }
        set_multiplier(program, p, program->multiplier[p] + sense * step);
        amount -= step * square;
        if (blocking < 0) {
            rescue->iterations++;
            if (reaches_range_end) /* rounding has put it beside that */
                set_multiplier(program, p, range_end);
            else
                add_working(rescue, program, p, side);
            return 1;
        }
        {
            int leaving = constraint_in(program, blocking);
            real rate = sense * program->direction[blocking];
            int leaving_side = side_in(program, blocking);
            drop_working(rescue, program, blocking,
                         rate > 0 ? least_of(program, leaving, leaving_side)
                                  : most_of(program, leaving, leaving_side));
        }
    }
}

/* Writes Farkas' proof to the multipliers, given the combination in ``direction``.
   Returns whether it is one. */
static int prove_contradiction(const Rescue *rescue, gpmpc_program *program,
                               const Violation *violation)
{
    real *ray = program->excess;
    int i;
    fill(ray, 0, constraint_count(program));
    for (i = 0; i < rescue->size; i++) {
        int p = constraint_in(program, i);
        real share = -(real)violation->sense * program->direction[i];
        int pulls = share * (real)side_in(program, i) >= 0;
        if (absolute(share) * rescue->length[p]
                > rescue->dependent * rescue->length[violation->p]
            && (pulls || program->lower[p] == program->upper[p]))
            ray[p] = share;
    }
    ray[violation->p] = (real)violation->sense;
    if (!proves_infeasibility(program, ray))
        return 0;
    copy(ray, program->multiplier, constraint_count(program));
    return 1;
}

/* Changes the working set until no constraint is violated; returns the status. */
static int run_rescue(Rescue *rescue, gpmpc_program *program, int limit)
{
    for (;;) {
        Violation violation;
        real rounding;
        int i;
        if (!correct_multipliers(rescue, program))
            return GPMPC_NUMERICAL_TROUBLE;
        if (!find_violation(rescue, program, &violation))
            return GPMPC_SOLVED;
        if (rescue->iterations >= limit)
            return GPMPC_ITERATION_LIMIT;
        rounding = ROUNDING_OF_DATA
                   * rounded_terms_of(program, violation.p, violation.side);
        if (satisfy_accurately(rescue, program, &violation, rounding))
            continue;
        if (prove_contradiction(rescue, program, &violation))
            return GPMPC_INFEASIBLE;
        for (i = 0; i < rescue->size; i++) {
            int p = constraint_in(program, i);
            rounding += ROUNDING_OF_DATA * absolute(program->direction[i])
                        * rounded_terms_of(program, p, side_in(program, i));
        }
        if (violation.amount > rounding)
            return GPMPC_NUMERICAL_TROUBLE;
        rescue->membership[violation.p] = PASSED_OVER;
    }
}

/* Solves a program once more from the working set of a solution, which it replaces. */
static void rescue_solution(const gpmpc_problem *problem, gpmpc_program *program,
                            gpmpc_solution *solution)
{
    static const real dependent[DISTANCES] = DEPENDENT_DISTANCES;
    Progress progress = {GPMPC_NUMERICAL_TROUBLE, 0, 0, 0, 0, 0};
    Rescue rescue;
    int guessed = solution->working;
    int attempt, i;
    progress.iterations = solution->iterations;
    progress.limit = solution->iterations + changes_left(program, solution->iterations);
    for (i = 0; i < guessed; i++)
        program->candidates[i] = solution->label[i];
    for (i = 0; i < constraint_count(program); i++) {
        write_column(program, i, program->scratch);
        rescue.length[i] = SQRT(dot(program->scratch, program->scratch, N));
    }
    /* in float each distance twice: residuals along the dynamics, then by P and G */
    for (attempt = 0; attempt < (GPMPC_IS_FLOAT ? 2 : 1) * DISTANCES; attempt++) {
        rescue.problem = attempt < DISTANCES ? problem : 0;
        rescue.dependent = dependent[attempt % DISTANCES]
                           / SQRT(program->pivot_share);
        start_rescue(&rescue, program, guessed);
        progress.status =
            run_rescue(&rescue, program, progress.limit - progress.iterations);
        progress.iterations += rescue.iterations;
        if (progress.status != GPMPC_NUMERICAL_TROUBLE)
            break;
    }
    progress.size = rescue.size;
    if (progress.status != GPMPC_NUMERICAL_TROUBLE) {
        write_solution(program, &progress, solution);
    } else { /* x of before is as good */
        solution->status = progress.status;
        solution->iterations = progress.iterations;
    }
}

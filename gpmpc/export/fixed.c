/* GPs in whole numbers, for float: their terms beta k are up to 1e6 times as large as
   their sum, and float has seven digits. Whole numbers of 32 bits have nine, their
   products of 64 bits are sums that round nothing, and a small core has them without
   a floating-point unit. Outside the range of these numbers, which is the range of the
   points and as much on each side, ``gp_evaluate`` falls back to double.

   A feature is in units of its reach R, a difference from -1 to 1 in 31 bits. With
   u_a = sum_d (x_id - q_d)^2 log2(e) / (2 l_ad^2) the kernel is k = sf2 2^-u. */
struct gp_fixed_tables {
    const double *centre;       /* of each feature (d,) */
    const double *units;        /* 2^31 / R (d,) */
    const int32_t *x;           /* the points in these units (d, N) */
    const uint32_t *scales;     /* of squared differences in u (k, d) */
    const int *shift;           /* of their sums, to 40 bits of u (k,) */
    const int32_t *weights;     /* beta, of which all sum to less than 2^31 (k, N) */
    const uint32_t *remainders; /* and the 32 bits that follow (k, N) */
    const double *mean_unit;    /* of a sum of beta k (k,) */
    const double *slope_units;  /* of a sum of beta k (x - q) (k, d) */
};

static const uint64_t ONE = (uint64_t)1 << 40; /* 1 in 40 bits */

/* (1 - 2^-f) / f on [0, 1) to ten digits: by powers of f, of changing signs, in 32
   bits, the highest one first */
static const uint32_t DECAY[8] = {
    4186u, 63221u, 659694u, 5725852u, 41309332u, 238388304u, 1031764990u, 2977044472u};

/* 2^-u, below 1; both in 40 bits after the point. ``lost`` is 1 - 2^-f of the fraction f
   in 64 bits; the whole part of u shifts 2^-f to the right. */
static uint64_t decayed(uint64_t u)
{
    uint64_t f = u & (ONE - 1);
    uint32_t top = (uint32_t)(f >> 8);
    uint32_t g = DECAY[0];
    uint64_t lost;
    int i;
    if (u >= 40 * ONE)
        return 0;
    for (i = 1; i < 8; i++)
        g = DECAY[i] - (uint32_t)(((uint64_t)g * top) >> 32);
    lost = (uint64_t)top * g + (((f & 255) * g) >> 8);
    return (ONE - 1 - (lost >> 24)) >> (u >> 40);
}

/* Writes x - q (d, N) and the squares in 31 bits. Returns whether the query is within
   the reach of the tables. */
static int write_differences(const gp_fixed_tables *fixed, const real *query,
                             int points, int features, int32_t *differences,
                             uint32_t *squares)
{
    int i, j;
    for (j = 0; j < features; j++) {
        double place = ((double)query[j] - fixed->centre[j]) * fixed->units[j];
        int32_t q;
        if (!(place > -1.5e9 && place < 1.5e9)) /* of 2^31; the points have 2^29 */
            return 0;
        q = (int32_t)place;
        for (i = 0; i < points; i++) {
            int32_t difference = fixed->x[j * points + i] - q;
            differences[j * points + i] = difference;
            squares[j * points + i] =
                (uint32_t)(((int64_t)difference * difference) >> 31);
        }
    }
    return 1;
}

/* Adds the squares of one feature to u. */
static void add_squares(uint32_t scale, const uint32_t *squares, int points,
                        uint64_t *u)
{
    int i;
    for (i = 0; i < points; i++)
        u[i] += (uint64_t)scale * squares[i];
}

/* Returns sum_i w_i d_i of 64 bits; the w sum to less than 2^31. */
static int64_t whole_dot(const int32_t *w, const int32_t *d, int size)
{
    int64_t total = 0;
    int i;
    for (i = 0; i < size; i++)
        total += (int64_t)w[i] * d[i];
    return total;
}

/* Writes the kernels of output a in 40 bits to ``u``, and beta k to ``weighted``;
   returns the sum of the latter in 62 bits. */
static int64_t weigh(const gp_fixed_tables *fixed, int a, int points, uint64_t *u,
                     int32_t *weighted)
{
    const int32_t *weights = fixed->weights + a * points;
    const uint32_t *remainders = fixed->remainders + a * points;
    int64_t total = 0;
    int i;
    for (i = 0; i < points; i++) {
        uint64_t kernel = decayed(u[i] >> fixed->shift[a]);
        uint32_t top = (uint32_t)(kernel >> 9);
        int32_t rest = (int32_t)(kernel & 511);
        int64_t product = (int64_t)weights[i] * (int32_t)top;
        u[i] = kernel;
        weighted[i] = (int32_t)((product + ((int64_t)1 << 30)) >> 31);
        total += product;
        total += (int64_t)(((uint64_t)remainders[i] * top) >> 32);
        total += ((int64_t)weights[i] * rest) >> 9;
    }
    return total;
}

/* As ``gp_evaluate``. Returns whether the query is within the reach of the tables. */
static int evaluate_fixed(const gp_tables *gp, const real *query, gpmpc_work *work,
                          real *mean, real *jacobian)
{
    const gp_fixed_tables *fixed = gp->fixed;
    int count = gp->points;
    int d = gp->features;
    int32_t *differences = work->in.whole.differences;
    uint32_t *squares = work->in.whole.squares;
    uint64_t *kernel = work->in.whole.kernel;
    int32_t *weighted = work->in.whole.weighted;
    int a, i, j;
    if (!write_differences(fixed, query, count, d, differences, squares))
        return 0;
    for (a = 0; a < gp->outputs; a++) {
        int64_t total;
        for (i = 0; i < count; i++)
            kernel[i] = 0;
        for (j = 0; j < d; j++)
            add_squares(fixed->scales[a * d + j], squares + j * count, count, kernel);
        total = weigh(fixed, a, count, kernel, weighted);
        mean[a] = (real)(gp->offset[a] + (double)total * fixed->mean_unit[a]);
        for (j = 0; j < d && jacobian; j++) {
            total = whole_dot(weighted, differences + j * count, count);
            jacobian[a * d + j] = (real)((double)total * fixed->slope_units[a * d + j]);
        }
#if GPMPC_KERNELS
        for (i = 0; i < count && work->lane >= 0; i++)
            work->kernels[(a * count + i) * GPMPC_LANES + work->lane] =
                (double)kernel[i] * gp->signal[a] / (double)ONE;
#endif
    }
    return 1;
}

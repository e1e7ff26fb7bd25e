/* The exponential without branch and table (Cody and Waite, 1980): x = j ln 2 + y with
   |y| <= ln(2) / 2, exp(x) = 2^j exp(y), exp(y) = 1 + y + y^2 g(y). Adding ``SHIFT``
   leaves j in the lowest bits, biased as an exponent is; there 2^j is made of it. */
static const wide SHIFT = 6755399441056767.0; /* 1.5 * 2^52 + 1023 */

static wide power_of_two(wide shifted)
{
    uint64_t bits;
    wide power;
    memcpy(&bits, &shifted, sizeof bits);
    bits <<= 52;
    memcpy(&power, &bits, sizeof power);
    return power;
}

/* The exponent of a kernel is at most log sf2; below -708 a kernel is nothing beside the
   others, and 2^j would be subnormal. What is not a number stays so. */
static wide exponential(wide x)
{
    wide shifted, j, y, g;
    x = x < -708.0 ? -708.0 : x;
    shifted = x * 1.4426950408889634 + SHIFT;
    j = shifted - SHIFT;
    y = (x - j * 0.6931471805599453) - j * 2.3190468138462996e-17;
    g = y * 2.510038319586702e-08 + 2.7620085455018414e-07;
    g = g * y + 2.7557268464831627e-06;
    g = g * y + 2.4801521302241082e-05;
    g = g * y + 0.00019841269863050506;
    g = g * y + 0.001388888891720967;
    g = g * y + 0.008333333333330063;
    g = g * y + 0.041666666666624136;
    g = g * y + 0.16666666666666669;
    g = g * y + 0.5000000000000001;
    g = (g * (y * y) + y) + 1.0;
    return g * power_of_two(shifted);
}

/* Returns start + sum x_i, in eight interleaved parts as registers of eight numbers
   take it: where large terms cancel, the order of a sum decides its last digits. */
static wide sum(wide start, const wide *x, int size)
{
    wide parts[8] = {0};
    int whole = size / 8 * 8;
    int i, lane;
    for (i = 0; i < whole; i += 8)
        for (lane = 0; lane < 8; lane++)
            parts[lane] += x[i + lane];
    for (i = whole; i < size; i++)
        parts[i - whole] += x[i];
    return ((parts[0] + parts[4]) + (parts[2] + parts[6]))
           + (((parts[1] + parts[5]) + (parts[3] + parts[7])) + start);
}

/* x'y in the same parts, whatever the length */
static wide wide_dot(const wide *x, const wide *y, int size)
{
    wide parts[8] = {0};
    wide total;
    int i, lane;
    for (i = 0; i + 8 <= size; i += 8)
        for (lane = 0; lane < 8; lane++)
            parts[lane] += x[i + lane] * y[i + lane];
    total = ((parts[0] + parts[4]) + (parts[2] + parts[6]))
            + ((parts[1] + parts[5]) + (parts[3] + parts[7]));
    for (; i < size; i++)
        total += x[i] * y[i];
    return total;
}

#if defined(__GNUC__)
/* Eight numbers as one value: gcc leaves several sums of eight as they are, which takes
   twice as long. */
__extension__ typedef wide eight __attribute__((vector_size(8 * sizeof(wide))));
#else
typedef struct {
    wide lane[8];
} eight;
#endif

/* sums <- sums + x y for eight numbers */
static void add_products(eight *sums, const eight *x, const wide *y)
{
#if defined(__GNUC__)
    eight now;
    memcpy(&now, y, sizeof now);
    *sums += *x * now;
#else
    int lane;
    for (lane = 0; lane < 8; lane++)
        sums->lane[lane] += x->lane[lane] * y[lane];
#endif
}

static wide total_of(const eight *sums)
{
    wide parts[8];
    memcpy(parts, sums, sizeof parts);
    return ((parts[0] + parts[4]) + (parts[2] + parts[6]))
           + ((parts[1] + parts[5]) + (parts[3] + parts[7]));
}

/* Writes x'y of three rows y, which follow each other: x is read once for them. The
   sums are those of ``wide_dot``. */
static void three_dots(const wide *x, const wide *y, int size, wide dots[3])
{
    eight first = {0};
    eight second = {0};
    eight third = {0};
    int i;
    for (i = 0; i + 8 <= size; i += 8) {
        eight now;
        memcpy(&now, x + i, sizeof now);
        add_products(&first, &now, y + i);
        add_products(&second, &now, y + size + i);
        add_products(&third, &now, y + 2 * size + i);
    }
    dots[0] = total_of(&first);
    dots[1] = total_of(&second);
    dots[2] = total_of(&third);
    for (; i < size; i++) {
        dots[0] += x[i] * y[i];
        dots[1] += x[i] * y[size + i];
        dots[2] += x[i] * y[2 * size + i];
    }
}

#if GPMPC_IS_FLOAT
typedef struct gp_fixed_tables gp_fixed_tables;
#endif

/* k GPs over the same N points of d features. */
typedef struct {
    int points;             /* their number N, which is not that of unknowns */
    int features;           /* d */
    int outputs;            /* k */
    const wide *x;          /* the points, feature after feature (d, N) */
    const wide *scales;     /* 1 / l^2 (k, d) */
    const wide *log_signal; /* log sf2 (k,) */
    const wide *signal;     /* sf2 (k,) */
    const wide *weights;    /* beta (k, N) */
    const wide *offset;     /* prior means (k,) */
    const wide *cholesky;   /* lower triangles of K + sn2 I = L L', or NULL */
#if GPMPC_IS_FLOAT
    const gp_fixed_tables *fixed; /* in whole numbers, or NULL */
#endif
} gp_tables;

/*{fixed}*/
/* Writes d mean / dx~_j of one output from beta_i k_i and x~_ij - x~_j. */
static void write_slopes(const wide *scales, const wide *weighted,
                         const wide *differences, int count, int d, real *slopes)
{
    int j;
    for (j = 0; j + 2 < d; j += 3) {
        wide dots[3];
        three_dots(weighted, differences + j * count, count, dots);
        slopes[j] = (real)(scales[j] * dots[0]);
        slopes[j + 1] = (real)(scales[j + 1] * dots[1]);
        slopes[j + 2] = (real)(scales[j + 2] * dots[2]);
    }
    for (j = d / 3 * 3; j < d; j++)
        slopes[j] =
            (real)(scales[j] * wide_dot(weighted, differences + j * count, count));
}

/* Evaluates the GPs at x~ (d,) and, where they are wanted, their derivatives (k, d).

     mean_a = offset_a + sum_i beta_ai k_ai,   k_ai = exp(log sf2_a - |z_i|^2_a / 2)
     d mean_a / dx~_d = sum_i beta_ai k_ai (x~_id - x~_d) / l_ad^2

   The kernels k_ai go to lane ``work->lane``, if it is not negative. */
static void gp_evaluate(const gp_tables *gp, const real *query, gpmpc_work *work,
                        real *mean, real *jacobian)
{
    int count = gp->points;
    int d = gp->features;
    wide *differences = work->in.numbers;
    wide *kernel = differences + d * count;
    wide *weighted = kernel + count;
    int a, i, j;
#if GPMPC_IS_FLOAT
    if (gp->fixed && evaluate_fixed(gp, query, work, mean, jacobian))
        return;
#endif
    for (j = 0; j < d; j++)
        for (i = 0; i < count; i++)
            differences[j * count + i] = gp->x[j * count + i] - query[j];
    for (a = 0; a < gp->outputs; a++) {
        const wide *scales = gp->scales + a * d;
        const wide *weights = gp->weights + a * count;
        for (i = 0; i < count; i++)
            kernel[i] = gp->log_signal[a];
        for (j = 0; j + 2 < d; j += 3) { /* kernels are read once for three features */
            const wide *first = differences + j * count;
            const wide *second = first + count;
            const wide *third = second + count;
            wide half1 = scales[j] / 2;
            wide half2 = scales[j + 1] / 2;
            wide half3 = scales[j + 2] / 2;
            for (i = 0; i < count; i++) {
                wide exponent = kernel[i] - half1 * (first[i] * first[i]);
                exponent -= half2 * (second[i] * second[i]);
                kernel[i] = exponent - half3 * (third[i] * third[i]);
            }
        }
        for (j = d / 3 * 3; j < d; j++) {
            const wide *difference = differences + j * count;
            wide half_scale = scales[j] / 2;
            for (i = 0; i < count; i++)
                kernel[i] -= half_scale * (difference[i] * difference[i]);
        }
        for (i = 0; i < count; i++)
            kernel[i] = exponential(kernel[i]);
        for (i = 0; i < count; i++)
            weighted[i] = kernel[i] * weights[i];
        mean[a] = (real)sum(gp->offset[a], weighted, count);
        if (jacobian)
            write_slopes(scales, weighted, differences, count, d, jacobian + a * d);
#if GPMPC_KERNELS
        for (i = 0; i < count && work->lane >= 0; i++)
            work->kernels[(a * count + i) * GPMPC_LANES + work->lane] = kernel[i];
#endif
    }
}

#if GPMPC_KERNELS
/* Rows of L that are solved together: their sums need not wait for each other. */
enum { TOGETHER = 4 };

#if defined(__GNUC__)
/* The lanes of a point as one value: gcc leaves loops over them as they are, which
   takes ten times as long. */
__extension__ typedef wide lanes
    __attribute__((vector_size(GPMPC_LANES * sizeof(wide))));
#endif

/* total <- sum_j L_ij v_j for each of some rows of L and each lane, j < first. */
static void known_part(const wide *const *rows, const wide *v, int first,
                       wide total[TOGETHER][GPMPC_LANES])
{
    int i, j;
#if defined(__GNUC__)
    lanes sums[TOGETHER] = {{0}};
    for (j = 0; j < first; j++) {
        lanes now;
        memcpy(&now, v + j * GPMPC_LANES, sizeof now);
        for (i = 0; i < TOGETHER; i++)
            sums[i] += rows[i][j] * now;
    }
    memcpy(total, sums, sizeof sums);
#else
    int lane;
    for (i = 0; i < TOGETHER; i++)
        for (lane = 0; lane < GPMPC_LANES; lane++)
            total[i][lane] = 0;
    for (j = 0; j < first; j++)
        for (i = 0; i < TOGETHER; i++)
            for (lane = 0; lane < GPMPC_LANES; lane++)
                total[i][lane] += rows[i][j] * v[j * GPMPC_LANES + lane];
#endif
}

/* v <- L^-1 v for all lanes of v (N, lanes); returns |v|^2 of each. A few rows at a
   time, so that L is read once for all points. */
static void whiten(const wide *L, wide *v, int points, wide square[GPMPC_LANES])
{
    int first, i, j, lane;
    for (lane = 0; lane < GPMPC_LANES; lane++)
        square[lane] = 0;
    for (first = 0; first < points; first += TOGETHER) {
        const wide *rows[TOGETHER];
        wide total[TOGETHER][GPMPC_LANES];
        int count = points - first < TOGETHER ? points - first : TOGETHER;
        for (i = 0; i < TOGETHER; i++) {
            int row = first + (i < count ? i : 0); /* the first again: not used */
            rows[i] = L + row * (row + 1) / 2;
        }
        known_part(rows, v, first, total);
        for (i = 0; i < count; i++) {
            wide *now = v + (first + i) * GPMPC_LANES;
            for (j = 0; j < i; j++)
                for (lane = 0; lane < GPMPC_LANES; lane++)
                    total[i][lane] +=
                        rows[i][first + j] * v[(first + j) * GPMPC_LANES + lane];
            for (lane = 0; lane < GPMPC_LANES; lane++) {
                now[lane] = (now[lane] - total[i][lane]) / rows[i][first + i];
                square[lane] += now[lane] * now[lane];
            }
        }
    }
}

/* Writes the variances of the points whose kernels were kept, which are lost, lane by
   lane, GPMPC_GP_OUTPUTS places each: variance_a = sf2_a - |L_a^-1 k_a|^2 */
static void gp_variances(const gp_tables *gp, gpmpc_work *work, real *variance)
{
    int count = gp->points;
    int a, lane;
    for (a = 0; a < gp->outputs; a++) {
        wide square[GPMPC_LANES];
        whiten(gp->cholesky + a * (count * (count + 1) / 2),
                    work->kernels + a * count * GPMPC_LANES, count, square);
        for (lane = 0; lane < GPMPC_LANES; lane++) {
            wide value = gp->signal[a] - square[lane];
            variance[lane * GPMPC_GP_OUTPUTS + a] = value > 0 ? (real)value : 0;
        }
    }
}
#endif

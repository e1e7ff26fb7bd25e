/* ------------------------------------------------------------------------------------
   The Kalman filter: a step is given measurements, and decides for the belief that
   they lead to (gpmpc/estimation/_kalman.py, _conditioning.py).

     predict:  mean <- m(mean, u),  covariance <- A covariance A' + V + noise
     update:   K = covariance H' S^-1 with S = H covariance H' + R,
               mean <- mean + K (y - h(mean)),  covariance <- covariance - K S K'

   The update takes one sensor after the other, and turns a root of the covariance by
   reflections instead of taking numbers of its size from each other: a prior may be as
   wide as one likes, and a sensor perfect.
   --------------------------------------------------------------------------------- */

/* What an update corrects: rows of what is measured, then of the states. */
enum { MEASURED = GPMPC_MEASURED, CORRECTED = GPMPC_MEASURED + GPMPC_STATES };

typedef struct {
    real root[GPMPC_MEASURED + GPMPC_STATES][GPMPC_STATES];
    real shift[GPMPC_MEASURED + GPMPC_STATES]; /* of the means */
    real unit_lower[GPMPC_MEASURED][GPMPC_MEASURED]; /* R = T diag(variance) T' */
    real variance[GPMPC_MEASURED];
    /* an entry below it is round-off: of its row before any sensor was taken */
    real negligible[GPMPC_MEASURED];
    real innovation[GPMPC_MEASURED];
    int is_missing[GPMPC_MEASURED];
} gpmpc_update;

/* Moves the belief on by a step, with the input that was applied. */
static void predict_belief(gpmpc_controller *controller)
{
    real A[GPMPC_STATES * GPMPC_STATES];
    real B[GPMPC_STATES * GPMPC_INPUTS];
    real V[GPMPC_STATES * GPMPC_STATES];
    real mean[GPMPC_STATES];
    real variance[GPMPC_LANES * GPMPC_AT_LEAST_ONE(GPMPC_GP_OUTPUTS)];
    gpmpc_belief *belief = &controller->belief;
    gpmpc_work *work = &controller->problem.work;
    work->lane = 0;
    filter_model(belief->mean, last_input(controller), work, mean, A, B);
    filter_model_variances(work, variance);
    filter_model_covariance(variance, V);
    work->lane = -1;
    add_scaled(1, filter_noise, V, n * n);
    copy(mean, belief->mean, n);
    move_covariance(A, V, belief->covariance, belief->covariance);
}

/* Writes a root L (n, n) with L L' = covariance. The largest variance that is left
   comes next, as a share of its state's own: what is round-off of that is none. */
static void write_root(const real *covariance, real *root)
{
    const real round_off = n * PIVOT_ROUNDING;
    real left[GPMPC_STATES];
    int i, j, l;
    fill(root, 0, n * n);
    for (i = 0; i < n; i++)
        left[i] = covariance[i * n + i];
    for (j = 0; j < n; j++) {
        int next = -1;
        real largest = round_off;
        real pivot;
        for (i = 0; i < n; i++)
            if (left[i] > largest * covariance[i * n + i]) {
                largest = left[i] / covariance[i * n + i];
                next = i;
            }
        if (next < 0)
            return;
        pivot = SQRT(left[next]);
        for (i = 0; i < n; i++) {
            real value = covariance[i * n + next];
            for (l = 0; l < j; l++)
                value -= root[i * n + l] * root[next * n + l];
            root[i * n + j] = left[i] > 0 ? value / pivot : 0;
        }
        root[next * n + j] = pivot;
        for (i = 0; i < n; i++)
            left[i] -= root[i * n + j] * root[i * n + j];
        left[next] = 0;
    }
}

/* Writes R = T diag(variance) T', T unit lower triangular; missing entries are apart. */
static void decorrelate(gpmpc_update *update)
{
    real left[GPMPC_MEASURED][GPMPC_MEASURED];
    int i, j, l;
    for (i = 0; i < MEASURED; i++)
        for (j = 0; j < MEASURED; j++) {
            int known = !update->is_missing[i] && !update->is_missing[j];
            left[i][j] = known ? measurement_noise[i * MEASURED + j] : 0;
            update->unit_lower[i][j] = i == j;
        }
    for (i = 0; i < MEASURED; i++) {
        real round_off = 16 * PIVOT_ROUNDING * measurement_noise[i * MEASURED + i];
        update->variance[i] = left[i][i] > round_off ? left[i][i] : 0;
        if (update->variance[i] <= 0)
            continue;
        for (j = i + 1; j < MEASURED; j++)
            update->unit_lower[j][i] = left[j][i] / update->variance[i];
        for (j = i + 1; j < MEASURED; j++)
            for (l = i + 1; l < MEASURED; l++)
                left[j][l] -= update->variance[i] * update->unit_lower[j][i]
                              * update->unit_lower[l][i];
    }
}

/* Writes what sensors show of the belief, and by how much they show something else. */
static void read_sensors(const gpmpc_belief *belief, const real *measured,
                         gpmpc_update *update)
{
    real expected[GPMPC_MEASURED];
    real slopes[GPMPC_MEASURED * GPMPC_STATES];
    int i, j, a;
    measurement(belief->mean, expected, slopes);
    product(slopes, update->root[MEASURED], MEASURED, n, n, update->root[0]);
    for (i = 0; i < MEASURED; i++) {
        update->is_missing[i] = !is_measured(measured[i]);
        update->innovation[i] = measured[i] - expected[i];
        for (a = 0; a < GPMPC_MEASURED_ANGLE_COUNT; a++)
            if (measured_angles[a] == i && !update->is_missing[i])
                update->innovation[i] -= whole_turns(update->innovation[i]);
    }
    decorrelate(update);
    for (i = 0; i < MEASURED; i++) {
        for (j = 0; j < i; j++)
            if (!update->is_missing[j]) {
                real factor = -update->unit_lower[i][j];
                add_scaled(factor, update->root[j], update->root[i], n);
                update->innovation[i] += factor * update->innovation[j];
            }
        update->negligible[i] =
            16 * PIVOT_ROUNDING * SQRT(dot(update->root[i], update->root[i], n));
    }
}

/* Corrects everything by sensor ``at``: a reflection turns its row into one column,
   which the noise takes the place of. */
static void take_sensor(gpmpc_update *update, int at)
{
    real row[GPMPC_STATES];
    real normal[GPMPC_STATES];
    real scale, length;
    real surprise = update->innovation[at] - update->shift[at];
    real square = update->variance[at];
    int pivot = 0;
    int i;
    for (i = 0; i < n; i++) {
        real entry = update->root[at][i];
        row[i] = absolute(entry) <= update->negligible[at] ? 0 : entry;
        square += row[i] * row[i];
        if (absolute(row[i]) > absolute(row[pivot]))
            pivot = i;
    }
    if (!(square > 0))
        return; /* a perfect sensor that shows nothing new */
    scale = SQRT(square);
    length = scale * (scale + absolute(row[pivot]));
    copy(row, normal, n);
    normal[pivot] += row[pivot] < 0 ? -scale : scale;
    for (i = 0; i < CORRECTED; i++) {
        real along = dot(update->root[i], normal, n) / length;
        update->shift[i] += dot(update->root[i], row, n) / square * surprise;
        add_scaled(-along, normal, update->root[i], n);
        update->root[i][pivot] = -along * SQRT(update->variance[at]);
    }
}

/* Corrects the belief by a measurement, of which entries that are not finite are
   missing. */
static void update_belief(gpmpc_controller *controller, const real *measured)
{
    gpmpc_belief *belief = &controller->belief;
    gpmpc_update update;
    int i, j;
    write_root(belief->covariance, &update.root[MEASURED][0]);
    read_sensors(belief, measured, &update);
    fill(update.shift, 0, CORRECTED);
    for (i = 0; i < MEASURED; i++)
        if (!update.is_missing[i])
            take_sensor(&update, i);
    add_scaled(1, update.shift + MEASURED, belief->mean, n);
    for (i = 0; i < n; i++)
        for (j = 0; j <= i; j++) {
            real value = dot(update.root[MEASURED + i], update.root[MEASURED + j], n);
            belief->covariance[i * n + j] = value;
            belief->covariance[j * n + i] = value;
        }
}

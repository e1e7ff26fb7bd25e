/* The controller's memory, and the calls by which it is used.

   gpmpc_reset(&controller);
   gpmpc_hold(&reference, set_point);
   every time step:
       status = gpmpc_step(&controller, measured, &reference, input);

   A step reads what was measured, decides, and writes the input to be applied. It
   allocates nothing, keeps no static variable, and takes a bounded number of
   iterations. What it writes is finite and within the bounds whatever happened: where
   a decision fails, the last plan goes on (GPMPC_HOLDS: the last input stays). */

#ifdef __cplusplus
extern "C" {
#endif

/* How a decision ended. The plan of the first and of GPMPC_SOFT_BOUND_MISSED was
   applied; of the others, too, where controller.failed is zero. */
enum gpmpc_status {
    GPMPC_SOLVED,
    GPMPC_INFEASIBLE,           /* no plan keeps the hard rows */
    GPMPC_ITERATION_LIMIT,      /* the quadratic program took too many changes */
    GPMPC_TIME_LIMIT,           /* never: a step knows no clock */
    GPMPC_NUMERICAL_TROUBLE,    /* the digits did not suffice, or were not finite */
    /* what was measured, or a parameter, is not finite; or a measurement is >= 1e30;
       or there are no reference inputs where deviations from them are weighed */
    GPMPC_INVALID_MEASUREMENT,
    GPMPC_FUNCTION_NOT_FINITE,  /* a constraint or an output is not */
    GPMPC_SOFT_BOUND_MISSED,    /* solved, but a soft bound is missed */
    GPMPC_STALLED,              /* never: a step takes one program */
    GPMPC_HARD_BOUND_MISSED     /* the program keeps a hard bound, the plan does not */
};

/* Array sizes; C has no array of none. */
#define GPMPC_AT_LEAST_ONE(size) ((size) > 0 ? (size) : 1)
#define GPMPC_SIZE (GPMPC_HORIZON * GPMPC_INPUTS) /* unknowns of the program */
#define GPMPC_RATE_ROWS (GPMPC_HAS_RATES * GPMPC_SIZE)
#define GPMPC_STATE_ROWS (GPMPC_HORIZON * GPMPC_ROWS)
/* rows of G: in feedback coordinates the bounds of inputs are rows, too */
#define GPMPC_G_ROWS (GPMPC_SIZE + GPMPC_RATE_ROWS + GPMPC_STATE_ROWS)
#define GPMPC_CONSTRAINTS (GPMPC_SIZE + GPMPC_G_ROWS)
#define GPMPC_SLOTS (GPMPC_SIZE + 1)
/* points whose variances are computed together */
#define GPMPC_LANES (GPMPC_TUBES ? 8 : 1)
/* [s_k; u_{k-1}; 1], of which the feedback is a function */
#define GPMPC_AUGMENTED (GPMPC_STATES + GPMPC_INPUTS + 1)

/* What is to be followed over the horizon. */
typedef struct {
    gpmpc_real states[GPMPC_HORIZON + 1][GPMPC_STATES]; /* r_0 .. r_H; r_0 is now */
    gpmpc_real inputs[GPMPC_HORIZON][GPMPC_INPUTS];     /* u*_0 .. u*_{H-1} */
    int has_inputs; /* whether the inputs are known: deviations are from them */
    /* of outputs and inequalities, by stage */
    gpmpc_real parameters[GPMPC_HORIZON][GPMPC_AT_LEAST_ONE(GPMPC_PARAMETERS)];
} gpmpc_reference;

#if GPMPC_FILTERS
/* What the filter knows of the state. */
typedef struct {
    gpmpc_real mean[GPMPC_STATES];
    gpmpc_real covariance[GPMPC_STATES * GPMPC_STATES];
} gpmpc_belief;
#endif

/* Where the model works. */
typedef struct {
    union {
        double numbers[GPMPC_AT_LEAST_ONE(GPMPC_DIFFERENCES + 2 * GPMPC_POINTS)];
#if GPMPC_IS_FLOAT
        struct {
            uint64_t kernel[GPMPC_AT_LEAST_ONE(GPMPC_POINTS)];
            int32_t differences[GPMPC_AT_LEAST_ONE(GPMPC_DIFFERENCES)];
            uint32_t squares[GPMPC_AT_LEAST_ONE(GPMPC_DIFFERENCES)];
            int32_t weighted[GPMPC_AT_LEAST_ONE(GPMPC_POINTS)];
        } whole;
#endif
    } in;
    int lane; /* where the kernels of a point are kept; negative: nowhere */
    double kernels[GPMPC_AT_LEAST_ONE(GPMPC_KERNELS * GPMPC_LANES)];
} gpmpc_work;

/* The solution of a quadratic program, from which the next one starts. */
typedef struct {
    int status;
    int iterations; /* changes of the working set */
    int rows;       /* of G; -1 where there is no solution */
    int working;    /* number of working constraints */
    int label[GPMPC_CONSTRAINTS]; /* p + 1 at the upper bound, -(p + 1) at the lower */
    gpmpc_real multiplier[GPMPC_CONSTRAINTS];
    gpmpc_real x[GPMPC_SIZE];
    gpmpc_real x_low[GPMPC_SIZE]; /* what x rounds off; zero in double */
    gpmpc_real violation;         /* of a bound of the program, at most */
} gpmpc_solution;

/* The memory of the dual active set; see gpmpc/qp/_workspace.py. */
typedef struct {
    int rows; /* of G */
    int soft; /* whether rows may be violated at a price */
    gpmpc_real pivot_share;       /* what cancellation left of the pivots of P */
    gpmpc_real length_of_q;       /* its largest |q_j| / sqrt(P_jj) */
    gpmpc_real negligible_length; /* an x below it counts as zero */
    /* by constraint, box first */
    gpmpc_real lower[GPMPC_CONSTRAINTS];
    gpmpc_real upper[GPMPC_CONSTRAINTS];
    gpmpc_real allowed_low[GPMPC_CONSTRAINTS];
    gpmpc_real allowed_high[GPMPC_CONSTRAINTS];
    gpmpc_real negligible[GPMPC_CONSTRAINTS];
    gpmpc_real norm[GPMPC_CONSTRAINTS];
    gpmpc_real cap[GPMPC_CONSTRAINTS];
    gpmpc_real multiplier[GPMPC_CONSTRAINTS];
    gpmpc_real value[GPMPC_CONSTRAINTS];
    gpmpc_real excess[GPMPC_CONSTRAINTS];
    /* what these round off, where it is known; else zero */
    gpmpc_real lower_low[GPMPC_CONSTRAINTS];
    gpmpc_real upper_low[GPMPC_CONSTRAINTS];
    gpmpc_real multiplier_low[GPMPC_CONSTRAINTS];
    gpmpc_real value_low[GPMPC_CONSTRAINTS];
    int row_end[GPMPC_CONSTRAINTS];
    int violated[GPMPC_CONSTRAINTS];
    int candidates[GPMPC_CONSTRAINTS];
    /* by variable */
    gpmpc_real free_rhs[GPMPC_SIZE];
    gpmpc_real slope[GPMPC_SIZE];
    gpmpc_real gradient[GPMPC_SIZE];
    gpmpc_real scratch[GPMPC_SLOTS];
    /* by slot of the working set */
    int label[GPMPC_SLOTS];
    int place[GPMPC_SLOTS];
    gpmpc_real bound[GPMPC_SLOTS];
    gpmpc_real free_value[GPMPC_SLOTS];
    gpmpc_real least_multiplier[GPMPC_SLOTS];
    gpmpc_real most_multiplier[GPMPC_SLOTS];
    gpmpc_real diagonal[GPMPC_SLOTS];
    gpmpc_real residual[GPMPC_SLOTS];
    gpmpc_real forward[GPMPC_SLOTS];
    gpmpc_real direction[GPMPC_SLOTS];
    gpmpc_real cosines[GPMPC_SLOTS];
    gpmpc_real sines[GPMPC_SLOTS];
    /* the program: 1/2 x'Px + q'x, lower <= [x; Gx] <= upper */
    gpmpc_real P[GPMPC_SIZE][GPMPC_SIZE];
    gpmpc_real q[GPMPC_SIZE];
    gpmpc_real G[GPMPC_G_ROWS][GPMPC_SIZE];
    gpmpc_real L[GPMPC_SIZE][GPMPC_SIZE];         /* P = L'L, reciprocal diagonal */
    gpmpc_real factor[GPMPC_SLOTS][GPMPC_SLOTS];  /* K_WW = F F', likewise */
    gpmpc_real w[GPMPC_SLOTS][GPMPC_SIZE];        /* w_p = L^-T c_p, by place */
} gpmpc_program;

/* The linear-quadratic problem along a plan: s_{k+1} = A_k s_k + B_k u_k + c_k. */
typedef struct {
    gpmpc_real A[GPMPC_STAGES][GPMPC_STATES][GPMPC_STATES];
    gpmpc_real B[GPMPC_STAGES][GPMPC_STATES][GPMPC_INPUTS];
    gpmpc_real c[GPMPC_STAGES][GPMPC_STATES];
#if GPMPC_IS_FLOAT
    gpmpc_real c_low[GPMPC_STAGES][GPMPC_STATES]; /* what c rounds off */
#endif
#if GPMPC_TUBES
    gpmpc_real V[GPMPC_STAGES][GPMPC_STATES][GPMPC_STATES];
    gpmpc_real covariances[GPMPC_HORIZON + 1][GPMPC_STATES][GPMPC_STATES];
#endif
#if GPMPC_TUBES || GPMPC_ROLLS_OUT || GPMPC_ELASTIC
    gpmpc_real gains[GPMPC_HORIZON][GPMPC_INPUTS][GPMPC_STATES];
#endif
    /* rows lower <= E s_{k+1} + D u_k <= upper */
#if GPMPC_SMOOTH
    gpmpc_real E[GPMPC_HORIZON][GPMPC_ROWS][GPMPC_STATES];
    gpmpc_real D[GPMPC_HORIZON][GPMPC_ROWS][GPMPC_INPUTS];
#endif
    gpmpc_real row_lower[GPMPC_HORIZON][GPMPC_AT_LEAST_ONE(GPMPC_ROWS)];
    gpmpc_real row_upper[GPMPC_HORIZON][GPMPC_AT_LEAST_ONE(GPMPC_ROWS)];
    gpmpc_real prices[GPMPC_AT_LEAST_ONE(GPMPC_ROWS)];
#if GPMPC_OUTPUTS
    /* squares z'Zz of outputs, z = [x_{k+1}; u_k; 1] */
    gpmpc_real Z[GPMPC_HORIZON][GPMPC_AUGMENTED][GPMPC_AUGMENTED];
#endif
    /* of the program in feedback coordinates: u_k = F_k [s_k; u_{k-1}; 1] + v_k */
    int has_feedback;
    int is_unstable; /* has_feedback by the limit of doubles: roll-outs follow it, too */
    gpmpc_real feedback[GPMPC_HORIZON][GPMPC_INPUTS][GPMPC_AUGMENTED];
    gpmpc_real hessians[GPMPC_HORIZON][GPMPC_INPUTS][GPMPC_INPUTS];
    /* of condensing */
    gpmpc_real BM[GPMPC_HORIZON][GPMPC_INPUTS][GPMPC_STATES];
    gpmpc_real gamma[2][GPMPC_STATES + GPMPC_INPUTS][GPMPC_SIZE];
    /* the plan that is linearised, and the one that the program leads to */
    gpmpc_real states[GPMPC_HORIZON + 1][GPMPC_STATES];
    gpmpc_real inputs[GPMPC_HORIZON][GPMPC_INPUTS];
    gpmpc_real targets[GPMPC_HORIZON + 1][GPMPC_STATES];
    gpmpc_real target_inputs[GPMPC_HORIZON][GPMPC_INPUTS];
    gpmpc_real previous_input[GPMPC_INPUTS];
    gpmpc_work work;
} gpmpc_problem;

/* A controller. What it keeps from step to step comes first; a binding of another
   language reads it (gpmpc/export/_c_types.py). */
typedef struct {
    /* what the next step needs of the last one */
    int has_input; /* whether an input was applied */
    int has_plan;  /* whether there is a plan to go on along */
    int policy_steps; /* by which the policy has moved that plan on */
    gpmpc_real input[GPMPC_INPUTS]; /* the one that was applied */
    gpmpc_real means[GPMPC_HORIZON + 1][GPMPC_STATES];
    gpmpc_real inputs[GPMPC_HORIZON][GPMPC_INPUTS];
    gpmpc_real disturbance[GPMPC_STATES]; /* as that plan was made with */
    gpmpc_solution solution;
    /* how the last step ended */
    int status;
    int failed; /* whether the policy chose its input */
    gpmpc_real violation; /* by how much its plan misses a bound; NAN where it failed */
    gpmpc_real estimate[GPMPC_STATES]; /* of a disturbance, that it decided with */
#if GPMPC_FILTERS
    gpmpc_belief belief; /* that the last step decided for */
#endif
    /* memory of a step */
    gpmpc_problem problem;
    gpmpc_program program;
    gpmpc_solution candidate;
#if GPMPC_ELASTIC
    gpmpc_solution trial_solution; /* under another price of rows that give way */
#endif
} gpmpc_controller;

/* Forgets everything: the next step is a first one. */
void gpmpc_reset(gpmpc_controller *controller);

/* Makes a set point the reference of the whole horizon. Its inputs, where deviations
   are weighed, and parameters are to be written behind it: until then they are unknown,
   and a step that needs them fails. */
void gpmpc_hold(gpmpc_reference *reference, const gpmpc_real state[GPMPC_STATES]);

/* Decides the input of a time step. Without a filter what is measured is the state (n),
   which counts as certain. With one (GPMPC_FILTERS) it is what sensors show: entries
   that are not finite, or 1e30 or more in size, are missing, and the last step's input
   counts as applied; where another one was, write it to controller.input before.
   A belief that is once no number, where the model has none, stays so, and all steps
   fail: gpmpc_reset begins again. */
int gpmpc_step(gpmpc_controller *controller,
               const gpmpc_real measured[GPMPC_MEASURED],
               const gpmpc_reference *reference, gpmpc_real input[GPMPC_INPUTS]);

/* The same for a state of which a mean and a covariance are known: no filter is asked,
   and none is told; where there is one, controller.belief stays a step behind. */
int gpmpc_step_belief(gpmpc_controller *controller, const gpmpc_real mean[GPMPC_STATES],
                      const gpmpc_real covariance[GPMPC_STATES * GPMPC_STATES],
                      const gpmpc_reference *reference,
                      gpmpc_real input[GPMPC_INPUTS]);

/* Bytes of a controller, for bindings of other languages. */
unsigned long gpmpc_memory(void);

#ifdef __cplusplus
}
#endif

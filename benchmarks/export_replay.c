/* Answers the questions of benchmarks/export.py, which come one after the other through
   the standard input: what the controller keeps from step to step (KEPT bytes), belief,
   reference, and the answer of another build of the same code, input and status. Prints
   how many came, the largest difference of an input, and how many statuses differ. */

#include <math.h>
#include <stdio.h>

#include "gpmpc.h"

typedef struct {
    gpmpc_real mean[GPMPC_STATES];
    gpmpc_real covariance[GPMPC_STATES * GPMPC_STATES];
    gpmpc_reference reference;
    gpmpc_real input[GPMPC_INPUTS];
    int status;
} question;

static gpmpc_controller controller;
static question asked;

static int read_one(void *target, size_t size)
{
    return fread(target, size, 1, stdin) == 1;
}

static int read_question(void)
{
    return read_one(&controller, KEPT) && read_one(asked.mean, sizeof asked.mean)
           && read_one(asked.covariance, sizeof asked.covariance)
           && read_one(&asked.reference, sizeof asked.reference)
           && read_one(asked.input, sizeof asked.input)
           && read_one(&asked.status, sizeof asked.status);
}

int main(void)
{
    long questions = 0;
    long other_statuses = 0;
    double largest = 0;
    for (;;) {
        gpmpc_real input[GPMPC_INPUTS];
        int status, i;
        gpmpc_reset(&controller);
        if (!read_question())
            break;
        status = gpmpc_step_belief(&controller, asked.mean, asked.covariance,
                                   &asked.reference, input);
        for (i = 0; i < GPMPC_INPUTS; i++)
            largest = fmax(largest, fabs((double)input[i] - (double)asked.input[i]));
        other_statuses += status != asked.status;
        questions++;
    }
    printf("%ld %.17g %ld\n", questions, largest, other_statuses);
    return 0;
}

/* Replays a recorded flight: what was measured goes to the controller, and its inputs
   are held beside those that Python decided on.

     ./replay replay.txt

   Every line of the file is a step: what was measured (p), the reference r_0 .. r_H
   ((H + 1) n), whether it has inputs (0 or 1), its inputs (H m), the parameters (H q),
   the input that Python decided on (m), and the status.
   Prints the largest deviation, and how many statuses differ.

   Written by gpmpc; the next export overwrites it. */

#include <math.h>
#include <stdio.h>

#include "gpmpc.h"

static gpmpc_controller controller;
static gpmpc_reference reference;

static int read_numbers(FILE *file, gpmpc_real *numbers, int count)
{
    int i;
    for (i = 0; i < count; i++) {
        double number;
        if (fscanf(file, "%lf", &number) != 1)
            return 0;
        numbers[i] = (gpmpc_real)number;
    }
    return 1;
}

int main(int count, char **arguments)
{
    gpmpc_real measured[GPMPC_MEASURED];
    gpmpc_real expected[GPMPC_INPUTS];
    gpmpc_real input[GPMPC_INPUTS];
    double worst = 0;
    int steps = 0;
    int other_statuses = 0;
    int expected_status;
    const char *name = count > 1 ? arguments[1] : "replay.txt";
    FILE *file = fopen(name, "r");
    if (!file) {
        fprintf(stderr, "%s cannot be read; write_replay of Python writes it\n", name);
        return 2;
    }
    gpmpc_reset(&controller);
    while (read_numbers(file, measured, GPMPC_MEASURED)) {
        int status, i;
        gpmpc_real has_inputs;
        if (!read_numbers(file, &reference.states[0][0],
                          (GPMPC_HORIZON + 1) * GPMPC_STATES)
            || !read_numbers(file, &has_inputs, 1)
            || !read_numbers(file, &reference.inputs[0][0],
                             GPMPC_HORIZON * GPMPC_INPUTS)
            || !read_numbers(file, &reference.parameters[0][0],
                             GPMPC_HORIZON * GPMPC_PARAMETERS)
            || !read_numbers(file, expected, GPMPC_INPUTS)
            || fscanf(file, "%d", &expected_status) != 1) {
            fprintf(stderr, "step %d is not whole\n", steps);
            (void)fclose(file);
            return 2;
        }
        reference.has_inputs = has_inputs != 0;
        status = gpmpc_step(&controller, measured, &reference, input);
        for (i = 0; i < GPMPC_INPUTS; i++) {
            double miss = fabs((double)input[i] - (double)expected[i]);
            if (!(miss <= worst))
                worst = miss == miss ? miss : HUGE_VAL; /* not a number */
        }
        other_statuses += status != expected_status;
        steps++;
    }
    (void)fclose(file);
    printf("%d steps, largest deviation %.3g, other statuses %d\n", steps, worst,
           other_statuses);
    return other_statuses > 0;
}

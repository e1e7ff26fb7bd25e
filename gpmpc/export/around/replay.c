/* Replays a recorded flight: what was measured goes to the controller, and its inputs
   are held beside those that Python decided on.

     ./replay replay.txt
     ./replay replay.txt 1e-6

   The first line is a comment. Every other one is a step: what was measured (p), the
   reference r_0 .. r_H ((H + 1) n), whether it has inputs (0 or 1), its inputs (H m),
   the parameters (H q), the input that Python decided on (m), and the status.
   Prints the largest deviation of an input, and how many statuses differ.

   Ends with 0 where the inputs are Python's: within 1e-4 of the largest input that
   Python decided on, in float within 1e-2, or within the share that is named. In double
   the statuses are the same, too; in float, rounding may decide on one.

   Written by gpmpc; the next export overwrites it. */

#include <math.h>
#include <stdio.h>
#include <stdlib.h>

#include "gpmpc.h"

static gpmpc_controller controller;
static gpmpc_reference reference;

/* Skips a line that begins with #. */
static void skip_comment(FILE *file)
{
    int next = fgetc(file);
    if (next != '#') {
        (void)ungetc(next, file);
        return;
    }
    while (next != '\n' && next != EOF)
        next = fgetc(file);
}

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
    const int in_float = sizeof(gpmpc_real) < sizeof(double);
    double worst = 0;
    double largest = 1e-6; /* smaller inputs are none */
    double share = in_float ? 1e-2 : 1e-4;
    int steps = 0;
    int other_statuses = 0;
    int expected_status;
    const char *name = count > 1 ? arguments[1] : "replay.txt";
    FILE *file = fopen(name, "r");
    if (!file) {
        fprintf(stderr, "%s cannot be read; write_replay of Python writes it\n", name);
        return 2;
    }
    if (count > 2)
        share = strtod(arguments[2], NULL);
    skip_comment(file);
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
            double size = fabs((double)expected[i]);
            double miss = fabs((double)input[i] - (double)expected[i]);
            if (size > largest)
                largest = size;
            if (!(miss <= worst))
                worst = miss == miss ? miss : HUGE_VAL; /* not a number */
        }
        other_statuses += status != expected_status;
        steps++;
    }
    if (!feof(file) || steps == 0) {
        fprintf(stderr, "%s holds no replay behind step %d\n", name, steps);
        (void)fclose(file);
        return 2;
    }
    (void)fclose(file);
    printf("%d steps, largest deviation %.3g, other statuses %d\n", steps, worst,
           other_statuses);
    if (!(worst <= share * largest))
        return 1;
    return !in_float && other_statuses > 0;
}

/* How long a step takes on this board: prints the longest of ten, in microseconds.
   Written by gpmpc; the next export overwrites it. */

#include <gpmpc.h>

static gpmpc_controller controller;
static gpmpc_reference reference; /* all zero, parameters too */

void setup()
{
    Serial.begin(115200);
    gpmpc_reset(&controller);
    reference.has_inputs = 1;
}

void loop()
{
    gpmpc_real measured[GPMPC_MEASURED];
    gpmpc_real input[GPMPC_INPUTS];
    unsigned long longest = 0;
    for (int step = 0; step < 10; step++) {
        unsigned long began;
        unsigned long taken;
        for (int i = 0; i < GPMPC_MEASURED; i++)
            measured[i] = static_cast<gpmpc_real>(0.01 * (step % 3 - 1));
        began = micros();
        gpmpc_step(&controller, measured, &reference, input);
        taken = micros() - began;
        if (taken > longest)
            longest = taken;
    }
    Serial.println(longest);
    delay(1000);
}

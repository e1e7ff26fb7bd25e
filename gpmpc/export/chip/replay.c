/* Replays the first steps of a flight on a board of QEMU, whose -icount gives each
   instruction a nanosecond that SysTick reads. Prints ticks, status and input of every
   step. */
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>

#include "gpmpc.h"
#include "flight.h"

extern void initialise_monitor_handles(void);
extern void _exit(int status);
int main(void);
void reset(void);

__attribute__((section(".vectors"), used)) void *const vectors[2] = {
    (void *)0x20400000, (void *)reset};

static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010;
static gpmpc_controller controller;

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the FPU is on */
    __asm volatile("dsb\nisb");
    initialise_monitor_handles();
    main();
    _exit(0);
}

int main(void)
{
    int k, i;
    systick[1] = 0xFFFFFF;
    systick[2] = 0;
    systick[0] = 5;
    gpmpc_reset(&controller);
    for (k = 0; k < STEPS; k++) {
        gpmpc_real input[GPMPC_INPUTS];
        uint32_t before, after;
        before = systick[2];
        gpmpc_step(&controller, measured[k], &references[k], input);
        after = systick[2];
        printf("%lu %d", (unsigned long)((before - after) & 0xFFFFFF),
               controller.status);
        for (i = 0; i < GPMPC_INPUTS; i++)
            printf(" %.17g", (double)input[i]);
        printf("\n");
    }
    fflush(stdout);
    return 0;
}

/* Replays the first steps of a flight on a board of QEMU, whose -icount gives each
   instruction a nanosecond that SysTick reads. Prints ticks, status and input of every
   step. SysTick has 24 bits, which a step may pass: an interrupt counts how often. */
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
void count_turn(void);

__attribute__((section(".vectors"), used)) void *const vectors[16] = {
    [0] = (void *)0x20400000, [1] = (void *)reset, [15] = (void *)count_turn};

#define LAST_TICK 0xFFFFFF /* it counts down from here */
static volatile uint32_t *const systick = (volatile uint32_t *)0xE000E010;
static volatile uint32_t turns;
static gpmpc_controller controller;

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the FPU is on */
    __asm volatile("dsb\nisb");
    initialise_monitor_handles();
    main();
    _exit(0);
}

void count_turn(void) { turns++; }

static uint64_t ticks(void)
{
    uint32_t before, left;
    do {
        before = turns;
        left = systick[2];
    } while (before != turns);
    return (uint64_t)before * (LAST_TICK + 1) + (LAST_TICK - left);
}

int main(void)
{
    int k, i;
    systick[1] = LAST_TICK;
    systick[2] = 0;
    systick[0] = 7; /* on, by the processor's clock, with its interrupt */
    while (systick[2] == 0) /* until its first turn begins */
        ;
    gpmpc_reset(&controller);
    for (k = 0; k < STEPS; k++) {
        gpmpc_real input[GPMPC_INPUTS];
        uint64_t before, taken;
        before = ticks();
        gpmpc_step(&controller, measured[k], &references[k], input);
        taken = ticks() - before;
        printf("%llu %d", (unsigned long long)taken, controller.status);
        for (i = 0; i < GPMPC_INPUTS; i++)
            printf(" %.17g", (double)input[i]);
        printf("\n");
    }
    fflush(stdout);
    return 0;
}

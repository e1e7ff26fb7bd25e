"""Counts the instructions of an exported controller on Cortex-M4F and M7.

    .venv/bin/python -m benchmarks.export_chip [--points 50] [--steps 60]
                                               [--precision float]

Needs ``arm-none-eabi-gcc`` with newlib, and ``qemu-system-arm``. The quadrotor of the
paper (n = 6, m = 3, H = 10) is learned from so many points and exported; its flight on
the Lorenz path is replayed in QEMU (boards mps2-an386 and mps2-an500), where
``-icount`` gives each instruction a nanosecond, read by SysTick. Printed for each core:
instructions of a step, median and worst, flash and RAM of the controller, and the
largest difference of an input from Python's, as a share of its range. They are
instructions: not a time on hardware. Writes ``outputs/benchmarks/export_chip.json``.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks import quadrotor
from benchmarks.timing import use_one_thread, write_results
from gpmpc.export import export_c
from gpmpc.mpc import GPMPC, ControlLoop, Reference
from gpmpc.propagation import Linearization
from gpmpc.simulation import closed_loop
from gpmpc.trajectories import states_along

HORIZON = 10
NANOSECONDS_A_TICK = 40  # SysTick of the boards runs at 25 MHz
CORES = {
    "Cortex-M4F": (
        "mps2-an386",
        "-mcpu=cortex-m4 -mfpu=fpv4-sp-d16 -mfloat-abi=hard -mthumb",
    ),
    "Cortex-M7": (
        "mps2-an500",
        "-mcpu=cortex-m7 -mfpu=fpv5-d16 -mfloat-abi=hard -mthumb",
    ),
}
LINKER_SCRIPT = """
MEMORY { FLASH (rx) : ORIGIN = 0x0, LENGTH = 4M
         RAM (rwx) : ORIGIN = 0x20000000, LENGTH = 4M }
ENTRY(reset)
SECTIONS {
  .text : { KEEP(*(.vectors)) *(.text*) *(.rodata*) } > FLASH
  .ARM.exidx : { *(.ARM.exidx*) } > FLASH
  .data : { *(.data*) } > RAM
  .bss : { *(.bss*) *(COMMON) end = .; _end = .; } > RAM
}
"""
MAIN = """
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
static gpmpc_reference reference;

void reset(void)
{
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* the FPU is on */
    __asm volatile("dsb\\nisb");
    initialise_monitor_handles();
    main();
    _exit(0);
}

int main(void)
{
    int k, i, j;
    systick[1] = 0xFFFFFF;
    systick[2] = 0;
    systick[0] = 5;
    gpmpc_reset(&controller);
    for (k = 0; k < STEPS; k++) {
        gpmpc_real input[GPMPC_INPUTS];
        uint32_t before, after;
        gpmpc_hold(&reference, path[k]);
        for (i = 0; i <= GPMPC_HORIZON; i++)
            for (j = 0; j < GPMPC_STATES; j++)
                reference.states[i][j] = path[k + i][j];
        before = systick[2];
        gpmpc_step(&controller, measured[k], &reference, input);
        after = systick[2];
        printf("%lu %d", (unsigned long)((before - after) & 0xFFFFFF),
               controller.status);
        for (i = 0; i < GPMPC_INPUTS; i++)
            printf(" %.9g", (double)input[i]);
        printf("\\n");
    }
    fflush(stdout);
    return 0;
}
"""


class Flight:
    """A flight in Python: what was measured, the path, the inputs."""

    def __init__(self, points: int, steps: int):
        model = quadrotor.trained("lorenz", size=points)
        self.controller = GPMPC(
            model,
            Linearization(),
            quadrotor.problem(),
            HORIZON,
            quadrotor.HOVER,
            iterations=1,
        )
        trajectory = quadrotor.TRAJECTORIES["lorenz"]
        self.path = states_along(trajectory, np.arange(steps + HORIZON + 1.0))
        flown = closed_loop(
            quadrotor.OUTER,
            self.controller,
            self.path,
            self.path[0],
            steps,
            noise=quadrotor.NOISE,
            on_failure="previous_plan",
        )
        self.measured = flown.measured[:steps]
        loop = ControlLoop(self.controller)
        self.inputs = np.array(
            [
                loop.input(state, Reference(self.path[k : k + HORIZON + 1]))
                for k, state in enumerate(self.measured)
            ]
        )

    def header(self) -> str:
        """Returns measurements and path as C."""

        def table(name: str, values: np.ndarray) -> str:
            rows = ",\n".join(
                "{" + ", ".join(repr(float(value)) for value in row) + "}"
                for row in values
            )
            shape = f"[{len(values)}][{values.shape[1]}]"
            return f"static const gpmpc_real {name}{shape} = {{{rows}}};\n"

        count = f"#define STEPS {len(self.measured)}\n"
        return count + table("measured", self.measured) + table("path", self.path)


def replay(flight: Flight, core: str, precision: Any, folder: Path) -> dict[str, Any]:
    """Compiles and replays a flight for one core; returns the row of a table."""
    board, options = CORES[core]
    export = export_c(flight.controller, folder, precision)
    (folder / "flight.h").write_text(flight.header())
    (folder / "main.c").write_text(MAIN)
    (folder / "board.ld").write_text(LINKER_SCRIPT)
    compiler = ["arm-none-eabi-gcc", *options.split(), "-std=gnu99", "-O2"]
    compiler += ["-ffunction-sections", "-ffp-contract=fast", f"-I{folder}/src"]
    parts = str(folder / "gpmpc.o")
    _run([*compiler, "-c", str(export.source), "-o", parts, "-fstack-usage"])
    program = str(folder / "flight.elf")
    link = [f"-T{folder}/board.ld", "-nostartfiles", "--specs=rdimon.specs"]
    sources = [str(folder / "main.c"), parts, "-lm", "-lc", "-lrdimon"]
    _run([*compiler, *link, "-o", program, *sources])
    size = _run(["arm-none-eabi-size", parts]).splitlines()[1].split()
    symbols = _run(["arm-none-eabi-nm", "-S", program])
    ram = sum(
        int(line.split()[1], 16)
        for line in symbols.splitlines()
        if line.endswith((" controller", " reference"))
    )
    usage = (folder / "gpmpc.su").read_text().splitlines()
    printed = _run(
        [
            *("qemu-system-arm", "-M", board, "-nographic", "-icount", "shift=0"),
            *("-semihosting-config", "enable=on,target=native", "-kernel", program),
        ]
    )
    rows = np.array([line.split() for line in printed.splitlines()], dtype=float)
    instructions = rows[:, 0] * NANOSECONDS_A_TICK
    differences = np.abs(rows[:, 2:] - flight.inputs).max(axis=0)
    ranges = flight.inputs.max(axis=0) - flight.inputs.min(axis=0)
    return {
        "core": core,
        "precision": precision,
        "median": float(np.median(instructions)),
        "worst": float(instructions.max()),
        "flash_bytes": int(size[0]),
        "ram_bytes": ram,
        "largest_frame_bytes": max(int(line.split("\t")[1]) for line in usage),
        "share": float((differences / ranges).max()),
    }


def _run(command: list[str]) -> str:
    """Runs a program; returns what it prints."""
    done = subprocess.run(command, capture_output=True, text=True, timeout=600)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    return done.stdout


def main() -> None:
    """Learns, compiles, replays and prints."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--points", type=int, default=50)
    parser.add_argument("--steps", type=int, default=60)
    parser.add_argument("--precision", default="float")
    arguments = parser.parse_args()
    use_one_thread()
    flight = Flight(arguments.points, arguments.steps)
    rows = []
    for core in CORES:
        with tempfile.TemporaryDirectory() as folder:
            row = replay(flight, core, arguments.precision, Path(folder))
        rows.append(row)
        print(row, flush=True)
    write_results("export_chip", rows)


if __name__ == "__main__":
    main()

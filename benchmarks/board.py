"""C code on a simulated Cortex-M board: its size, its stack, its instructions, its answers."""

import shutil
import struct
import subprocess
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

__all__ = ["BOARDS", "Board", "Measured", "on_board", "sizes_of"]

HERE = Path(__file__).parent
_PACKAGES = {
    "arm-none-eabi-gcc": "gcc-arm-none-eabi libnewlib-arm-none-eabi",
    "qemu-system-arm": "qemu-system-arm",
}
_SECONDS = 300


@dataclass(frozen=True)
class Board:
    """A machine of QEMU.

    Attributes:
        machine: Its name there.
        flags: Of the compiler.
        flash: Address of the code.
        ram: Address of the memory, of 2 MiB.
    """

    machine: str
    flags: tuple[str, ...]
    flash: int
    ram: int


_HARD = "-mfloat-abi=hard"
BOARDS = {
    "Cortex-M3": Board("mps2-an385", ("-mcpu=cortex-m3",), 0x00000000, 0x20000000),
    "Cortex-M4F": Board(
        "mps2-an386", ("-mcpu=cortex-m4", "-mfpu=fpv4-sp-d16", _HARD), 0x00000000, 0x20000000
    ),
    "Cortex-M33": Board(
        "mps2-an505", ("-mcpu=cortex-m33", "-mfpu=fpv5-sp-d16", _HARD), 0x10000000, 0x38000000
    ),
}
"""By their processors; the first has no unit for floating-point numbers."""


@dataclass(frozen=True)
class Measured:
    """What code takes on a board.

    Attributes:
        flash: Bytes of code and constants, those of libm included.
        ram: Bytes of static memory.
        stack: Bytes below the caller's frame.
        instructions: Of one answer, on the mean.
        answers: (B, m) float32 actions.
    """

    flash: int
    ram: int
    stack: int
    instructions: int
    answers: np.ndarray


def on_board(board: Board, source: str, header: str, states: np.ndarray) -> Measured:
    """Compile a student's C for a board, and let the board answer states.

    Args:
        board: Where.
        source: C99 with a function `student`, as `header` declares it.
        header: As `fdtasil export RUN student.h` writes it.
        states: (B, n) float32.

    Raises:
        RuntimeError: If a tool is missing or fails; it says which packages of Debian to install.
    """
    for tool, packages in _PACKAGES.items():
        if shutil.which(tool) is None:
            raise RuntimeError(f"no {tool}: on Debian, apt-get install {packages}")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "student.c").write_text(source)
        (folder / "student.h").write_text(header)
        (folder / "states.h").write_text(_states(states))
        whole, without = _linked(board, folder), _linked(board, folder, "-DWITHOUT")
        machine = ["qemu-system-arm", "-M", board.machine, "-display", "none", "-monitor", "none"]
        machine += ["-serial", "none", "-icount", "shift=0"]
        said = _run([*machine, "-semihosting-config", "enable=on", "-kernel", str(whole)])
        (flash, ram), (flash_without, ram_without) = sizes_of(whole), sizes_of(without)
    head, *lines = said.splitlines()
    turns, calibration, ticks, stack = (int(number, 16) for number in head.split())
    bits = [struct.pack(">I", int(number, 16)) for line in lines for number in line.split()]
    answers = np.frombuffer(b"".join(bits), ">f4").reshape(len(states), -1)
    instructions = round(2 * turns / calibration * ticks / len(states))
    sizes = flash - flash_without, ram - ram_without
    return Measured(*sizes, stack, instructions, answers.astype(np.float32))


def sizes_of(file: Path, size: str = "arm-none-eabi-size") -> tuple[int, int]:
    """Return the bytes of flash and of static memory of an object file or a program."""
    text, data, bss = map(int, _run([size, str(file)]).splitlines()[1].split()[:3])
    return text + data, data + bss


def _linked(board: Board, folder: Path, *flags: str) -> Path:
    program = folder / f"program{len(flags)}"
    layout = {"FLASH": board.flash, "RAM": board.ram, "RAM_SIZE": 2**21}
    _run(
        [
            *("arm-none-eabi-gcc", "-std=gnu99", "-O2", "-mthumb"),
            *(
                *board.flags,
                "-ffunction-sections",
                "-fdata-sections",
                "-nostartfiles",
                "--specs=nano.specs",
                *flags,
            ),
            *(f"-Wl,--defsym={name}={value}" for name, value in layout.items()),
            *("-Wl,--gc-sections", "-T", str(HERE / "board.ld"), f"-I{folder}", "-o"),
            *(str(program), str(HERE / "board.c"), str(folder / "student.c"), "-lm"),
        ]
    )
    return program


def _states(states: np.ndarray) -> str:
    rows = (", ".join(f"{float(x).hex()}f" for x in row) for row in states)
    body = ",\n".join(f"{{{row}}}" for row in rows)
    return (
        f"#define STATES {len(states)}\n"
        f"static const float states[STATES][STUDENT_OBSERVATIONS] = {{\n{body}}};\n"
    )


def _run(command: list[str]) -> str:
    done = subprocess.run(
        command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, timeout=_SECONDS
    )
    if done.returncode:
        raise RuntimeError(f"{command[0]} failed: {done.stdout[-1000:]}")
    return done.stdout

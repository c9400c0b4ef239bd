"""Instructions of compiled kernels by class, read from what ``nvdisasm`` prints for a cubin."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

CLASSES = {
    "FP32": r"F(ADD|MUL|FMA|MNMX|SEL|SET|SETP|CHK|SWZADD)\b",
    "MUFU": r"MUFU",
    "shared": r"(LDS|STS|LDSM)\b",
    "global": r"(LDG|STG|LD|ST)\b",
    "atomic": r"(RED|ATOM)",
    "SHFL": r"SHFL",
    "vote": r"(VOTE|MATCH)",
    "barrier": r"BAR",
    "branch": r"(BRA|BRX|JMP|CALL|RET|EXIT|BSSY|BSYNC|WARPSYNC|BREAK)\b",
    "local": r"(LDL|STL)\b",
}
"""Patterns of opcodes by class. All others (integers, moves, conversions, constants) count as ``other``."""

_INSTRUCTION = re.compile(r"/\*([0-9a-f]{4,})\*/\s+(?:@!?U?P\w+\s+)?([A-Z][\w.]*)([^;]*);")
_LABEL = re.compile(r"^(\.L_x_\d+):")
_KERNEL = re.compile(r"^\.text\.(\S+):")
_TARGET = re.compile(r"`\((\.L_x_\d+)\)")


class Instruction(NamedTuple):
    address: int
    opcode: str
    operands: str


class Code(NamedTuple):
    """Instructions of a kernel and the addresses of its labels."""

    instructions: list[Instruction]
    labels: dict[str, int]


def find_tool() -> str | None:
    """Return the path of ``nvdisasm``: on the PATH, or from the package nvidia-cuda-nvdisasm."""
    found = shutil.which("nvdisasm")
    if found is None:
        packaged = sorted(path for root in sys.path for path in Path(root).glob("nvidia/*/bin/nvdisasm"))
        found = str(packaged[0]) if packaged else None
    return found


def tool_version(tool: str) -> str:
    """Return the version that the tool states."""
    text = subprocess.run([tool, "--version"], capture_output=True, text=True, check=True, timeout=60).stdout
    match = re.search(r"V(\d+\.\d+\.\d+)", text)
    return match[1] if match else text.strip()


def disassemble(tool: str, cubin: Path) -> dict[str, Code]:
    """Return the code of each kernel of a cubin, by its symbol."""
    command = [tool, "-c", str(cubin)]
    return parse(subprocess.run(command, capture_output=True, text=True, check=True, timeout=300).stdout)


def parse(text: str) -> dict[str, Code]:
    """Return the code of each kernel in a disassembly."""
    found: dict[str, Code] = {}
    code, waiting = Code([], {}), []
    for line in text.splitlines():
        if match := _KERNEL.match(line):
            code, waiting = found.setdefault(match[1], Code([], {})), []
        elif match := _LABEL.match(line):
            waiting.append(match[1])
        elif match := _INSTRUCTION.search(line):
            address = int(match[1], 16)
            code.labels.update(dict.fromkeys(waiting, address))
            waiting = []
            if match[2] != "NOP":
                code.instructions.append(Instruction(address, match[2], match[3]))
    return found


def class_of(opcode: str) -> str:
    return next((name for name, pattern in CLASSES.items() if re.match(pattern, opcode)), "other")


def count(instructions: list[Instruction]) -> dict[str, int]:
    """Count instructions by class; ``all`` is their sum."""
    counts = Counter(class_of(instruction.opcode) for instruction in instructions)
    return {"all": len(instructions), **{name: counts[name] for name in (*CLASSES, "other")}}


class Loop(NamedTuple):
    """The innermost loop of a compositing kernel, whose round is one splat at one warp."""

    hit: list[Instruction]
    """All instructions of a round in which some pixel of the warp uses the splat."""
    miss: list[Instruction]
    """Those of a round in which none does."""


def innermost_loop(code: Code, opcode: str) -> Loop:
    """Return the shortest loop that holds ``opcode``: all of it, and without what the next branch after it skips.

    A loop is what lies between a branch and its target further up.

    Raises:
        ValueError: no loop holds the opcode, or no branch skips a part of it.
    """
    places = [i.address for i in code.instructions if i.opcode.startswith(opcode)]
    loops = []
    for branch in code.instructions:
        begin = _target(code, branch)
        if any(begin <= place < branch.address for place in places):
            loops.append((branch.address - begin, begin, branch.address))
    if not loops:
        raise ValueError(f"no loop holds {opcode}")
    _, begin, end = min(loops)
    hit = [i for i in code.instructions if begin <= i.address <= end]
    place = next(place for place in places if begin <= place < end)
    for branch in hit:
        target = _target(code, branch)
        if place < branch.address < target <= end:
            return Loop(hit, [i for i in hit if i.address <= branch.address or i.address >= target])
    raise ValueError(f"no branch after {opcode} skips the rest of the loop")


def _target(code: Code, branch: Instruction) -> int:
    """Return the address that an instruction branches to; its own where it does not branch."""
    target = _TARGET.search(branch.operands) if branch.opcode.startswith("BRA") else None
    return code.labels.get(target[1], branch.address) if target else branch.address

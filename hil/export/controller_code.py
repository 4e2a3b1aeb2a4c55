"""Code of the identified arm for a controller, compiled and compared where a compiler is found."""

from __future__ import annotations

import ctypes
import re
import shutil
import subprocess
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np

from hil.base.arrays import Array
from hil.base.errors import InputError
from hil.base.files import write_files, write_into
from hil.pipeline.identified_model import IdentifiedModel
from identification.export.controller.c_source import CSource, Precision, c_source
from identification.export.controller.reference import reference_torque
from identification.export.controller.structured_text import structured_text
from identification.export.controller.tables import control_tables
from identification.export.exported_arm import ExportedArm
from identification.export.simulators import RANDOM_STATES, random_states
from identification.export.urdf import WriteBackError

CodeName = Literal["c", "st"]

AGREES: Final[dict[Precision, float]] = {"double": 1e-12, "single": 1e-4}
"""Largest difference of the compiled code, relative to the largest torque of a joint."""

_COMPILERS: Final = ("cc", "gcc", "clang")
STRICT: Final = ("-std=c99", "-O2", "-Wall", "-Wextra", "-Wconversion", "-pedantic", "-Werror")
"""Flags of a compiler that lets no warning pass."""
_IDENTIFIER: Final = re.compile(r"[a-z][a-z0-9_]*\Z")
_COMPILER_TIMEOUT: Final = 60.0  # for a compiler
_TIMED_CALLS: Final = 100_000
_TIMER: Final = """
#include <time.h>
double seconds_of_a_call(long calls, long states, const arm_real *q, const arm_real *v,
                         const arm_real *a)
{
    static arm_real tau[ARM_JOINTS];
    volatile arm_real sum = 0;
    const clock_t begin = clock();
    for (long k = 0, row = 0; k < calls; k++, row = row + 1 < states ? row + 1 : 0) {
        arm_torque(&q[ARM_JOINTS * row], &v[ARM_JOINTS * row], &a[ARM_JOINTS * row], tau);
        sum = sum + tau[0];
    }
    return (double)(clock() - begin) / CLOCKS_PER_SEC / (double)calls;
}
"""


@dataclass(frozen=True)
class CompiledCheck:
    """What the compiled code computed."""

    compiler: str
    difference: float  #: largest, relative to the largest torque of the joint
    seconds: float  #: of one call of the whole torque


@dataclass(frozen=True)
class ExportedCode:
    """Summary of written code."""

    paths: tuple[Path, ...]
    check: CompiledCheck | str  #: or why there is none
    verdict: str
    origin: str = ""  #: of the parameters, where they were not identified for these files

    def lines(self) -> list[str]:
        """Return the summary as lines of text."""
        lines = [*([f"parameters: {self.origin}"] if self.origin else [])]
        lines.append(f"written: {', '.join(map(str, self.paths))}")
        if isinstance(self.check, str):
            lines.append(f"not compiled: {self.check}")
        else:
            lines.append(
                f"compiled by {self.check.compiler}: torque within {self.check.difference:.1e} of"
                f" pinocchio's at {RANDOM_STATES} random states; one call takes"
                f" {1e6 * self.check.seconds:.2f} us on this computer"
            )
        return [*lines, self.verdict]

    def to_dict(self) -> dict[str, object]:
        """Return the summary for JSON."""
        compiled = None if isinstance(self.check, str) else self.check
        return {
            "paths": [*map(str, self.paths)],
            "compiler": compiled and compiled.compiler,
            "read_back": compiled and compiled.difference,
            "seconds_per_call": compiled and compiled.seconds,
            "not_read_back": self.check if compiled is None else None,
            "verdict": self.verdict,
            "parameters_from": self.origin or None,
        }


def export_code(
    model: IdentifiedModel, output: Path, to: CodeName, precision: Precision
) -> ExportedCode:
    """Write code for a controller; C is compiled and compared with pinocchio first.

    Args:
        model: the identified arm.
        output: NAME.c, whose header becomes NAME.h, or NAME.st; names in the code begin with NAME.
        to: the language.
        precision: of numbers in C.

    Raises:
        InputError: NAME is no identifier in lower case, or structured text in single precision.
        WriteBackError: the code computes another torque, or does not compile.
    """
    name = output.stem
    if output.suffix != f".{to}" or not _IDENTIFIER.match(name):
        raise InputError(
            output,
            "cannot name controller code",
            field="--output",
            remedy=f"give NAME.{to} with NAME of lower-case letters, digits and _; names of all"
            " functions begin with it",
        )
    tables = control_tables(model.arm)
    remarks = _remarks(model)
    check: CompiledCheck | str
    if to == "c":
        code = c_source(tables, name, remarks, precision, model.thresholds)
        check = checked(code, name, model.arm, precision)
        files = {output.name: code.source, f"{name}.h": code.header}
    else:
        if precision == "single":
            raise InputError(
                None,
                "structured text has numbers of double precision (LREAL)",
                field="--precision",
                remedy="leave it out",
            )
        check = "structured text has no compiler here; the tests of hil run its function blocks"
        files = {output.name: structured_text(tables, name, remarks)}
    return ExportedCode(write_into(output.parent, files), check, model.verdict, model.origin)


def _remarks(model: IdentifiedModel) -> tuple[str, ...]:
    """Return the verdict first, the long list of archives last."""
    unknown = ", ".join(model.estimate.undetermined)
    others = {k: v for k, v in model.provenance.items() if k not in ("verdict", "archives")}
    return (
        f"Verdict: {model.verdict}",
        "Identified by hil; bodies are physically consistent parameters.",
        *([f"Not determined by the data: {unknown}."] if unknown else []),
        *(f"{key}: {value}" for key, value in others.items()),
        f"archives: {model.provenance.get('archives', '')}",
    )


def checked(
    code: CSource, name: str, arm: ExportedArm, precision: Precision
) -> CompiledCheck | str:
    """Compile code in a temporary folder, and compare its torque with pinocchio's.

    Args:
        code: of the arm.
        name: of the function.
        arm: that was written.
        precision: of the numbers.

    Returns:
        the comparison, or why there is none.

    Raises:
        WriteBackError: it does not compile, or its torque differs.
    """
    compiler = next(filter(shutil.which, _COMPILERS), None)
    if compiler is None:
        return f"there is no C compiler ({', '.join(_COMPILERS)}) on this computer"
    states = random_states(arm)
    rows = states.position, states.velocity, states.acceleration
    expected = reference_torque(arm, states)
    with tempfile.TemporaryDirectory() as folder:
        compiled = CompiledArm.of(code, name, Path(folder), compiler, precision)
        torque = compiled.torque(*rows)
        seconds = compiled.seconds(*rows)
    largest = np.abs(expected).max(axis=0)
    error = np.abs(torque - expected).max(axis=0) / np.where(largest > 0.0, largest, 1.0)
    if not error.max() <= AGREES[precision]:
        joint = arm.model.joint_names[int(np.argmax(error))]
        raise WriteBackError(
            f"compiled, the torque of joint {joint!r} differs by {error.max():.2g} of its largest"
            " one"
        )
    return CompiledCheck(compiler, float(error.max()), seconds)


class CompiledArm:
    """The functions of compiled code; the library's file may go once it is open.

    Args:
        library: shared library.
        name: with which its functions begin.
        n_joints: number of joints.
        precision: of its numbers.
    """

    def __init__(self, library: Path, name: str, n_joints: int, precision: Precision) -> None:
        self.library = ctypes.CDLL(str(library))
        self._name = name
        self._n = n_joints
        self._real = np.dtype(np.float64 if precision == "double" else np.float32)
        self.ctype: Any = ctypes.c_double if precision == "double" else ctypes.c_float

    @classmethod
    def of(
        cls, code: CSource, name: str, folder: Path, compiler: str, precision: Precision
    ) -> CompiledArm:
        """Compile code in a folder, with every warning an error.

        Args:
            code: of the arm.
            name: of the function.
            folder: of the files.
            compiler: its command.
            precision: of the numbers.

        Raises:
            WriteBackError: it does not compile.
        """
        timer = re.sub(r"\barm_", f"{name}_", _TIMER).replace("ARM_", f"{name.upper()}_")
        sources = {f"{name}.h": code.header, f"{name}.c": code.source}
        write_files(folder, {**sources, "timer.c": f'#include "{name}.h"\n{timer}'})
        _compile(compiler, [*STRICT, "-c", f"{name}.c", "-o", "strict.o"], folder)
        library = folder / "arm.so"
        shared = ["-std=c99", "-O2", "-fPIC", "-shared", f"{name}.c", "timer.c", "-lm"]
        _compile(compiler, [*shared, "-o", library.name], folder)
        count = re.search(rf"define {name.upper()}_JOINTS (\d+)", code.header)
        assert count is not None, "the header defines its number of joints"
        return cls(library, name, int(count[1]), precision)

    def function(self, name: str) -> Any:
        """Return a function by its name without the prefix."""
        return getattr(self.library, f"{self._name}_{name}")

    def array(self, values: Array) -> Array:
        """Return values as the code reads them."""
        return np.ascontiguousarray(values, dtype=self._real)

    def torque(self, q: Array, v: Array, a: Array) -> Array:
        """Return the whole torque (m, n) at positions, speeds, accelerations (m, n)."""
        call = self.function("torque")
        tau = np.empty(q.shape, self._real)
        states = [self.array(values) for values in (q, v, a)]
        for k, row in enumerate(tau):
            call(*(pointer(values[k]) for values in states), pointer(row))
        return tau.astype(np.float64)

    def seconds(self, q: Array, v: Array, a: Array) -> float:
        """Return the time of one call of the whole torque [s]."""
        timed = self.library.seconds_of_a_call
        timed.restype = ctypes.c_double
        states = [self.array(values) for values in (q, v, a)]
        count = ctypes.c_long(len(q))
        return float(timed(ctypes.c_long(_TIMED_CALLS), count, *map(pointer, states)))


def pointer(values: Array) -> ctypes.c_void_p:
    """Return the address of a contiguous array for a function of C."""
    return ctypes.c_void_p(values.ctypes.data)


def _compile(compiler: str, arguments: Sequence[str], folder: Path) -> None:
    command = [compiler, *arguments]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=_COMPILER_TIMEOUT,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise WriteBackError(f"{compiler} cannot be run: {error}") from error
    if done.returncode != 0:
        said = (done.stderr.strip() or f"exit status {done.returncode}").splitlines()
        raise WriteBackError(f"{compiler} does not compile the code: {said[0]}")

"""Pure functions of rows, compiled: arrays (N, k) in, one array (N, j) out.

The tracer of `quadrl.base.trace` generates the C of one row, and LANES rows are computed side by
side with vector instructions. The operations are NumPy's, in the same order, except that
comparisons may drop a NaN. `reverse` makes the function of the derivatives, from the same trace.
"""

# pyright: standard
# What is traced takes arrays of symbols.
from __future__ import annotations

import ctypes
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from quadrl.base.rotation import Array
from quadrl.base.trace import Trace, symbolic, symbols
from quadrl.engines import native
from quadrl.engines.native import compiling

FUNCTION = """
static inline __attribute__((always_inline)) void {name}_one(
    const double* restrict c, const Lanes* restrict x, Lanes* restrict y, int i) {{
    {body}
}}

// One row needs no vectors, and sines of one row only.
{linkage} VECTORISED void {name}(const double* constants, const Lanes* restrict x,
                                 Lanes* restrict y, int rows) {{
  {constants}
  if (rows == 1) {{
    {name}_one(c, x, y, 0);
  }} else {{
    for (int i = 0; i < LANES; ++i) {name}_one(c, x, y, i);
  }}
}}
"""
SOURCE = """#include <math.h>
#include <stdint.h>
#include <string.h>
{export}
#pragma GCC optimize("no-trapping-math")
enum {{ LANES = 8, IN = {taken}, OUT = {given} }};
typedef double Lanes[LANES];
// An array of `width` numbers a row: row i stands at i * stride.
typedef struct {{
  double* at;
  int64_t stride, width;
}} Rows;
{function}
// Computes n rows, those of a list or the first ones.
QUADRL_EXPORT void run(const double* constants, const Rows* in, const Rows* out, int64_t n,
                       const int64_t* ids) {{
  Lanes x[IN], y[OUT];
  for (int64_t first = 0; first < n; first += LANES) {{
    const int filled = n - first < LANES ? (int)(n - first) : LANES;
    int64_t row[LANES];
    for (int i = 0; i < LANES; ++i) {{  // spare lanes: twins
      const int64_t at = first + (i < filled ? i : 0);
      row[i] = ids ? ids[at] : at;
    }}
    Lanes* next = x;
    for (const Rows* r = in; next < x + IN; ++r) {{
      for (int64_t k = 0; k < r->width; ++k, ++next) {{
        for (int i = 0; i < LANES; ++i) (*next)[i] = r->at[row[i] * r->stride + k];
      }}
    }}
    compute(constants, (const Lanes*)x, y, filled);
    next = y;
    for (const Rows* r = out; next < y + OUT; ++r) {{
      for (int64_t k = 0; k < r->width; ++k, ++next) {{
        for (int i = 0; i < filled; ++i) r->at[row[i] * r->stride + k] = (*next)[i];
      }}
    }}
  }}
}}
"""
WITHOUT_HEX = {"inf": "INFINITY", "-inf": "-INFINITY", "nan": "NAN"}
COPIED = 512
"""Most constants that a function copies, so that it may read them on either side of a choice."""


class RowFunction:
    """A pure function of rows, in C."""

    def __init__(
        self,
        function: Callable[..., Array],
        *widths: int,
        sound: bool = True,
        max_operations: float = math.inf,
        fixed: int | None = None,
    ) -> None:
        """Trace a function, which is compiled at its first use.

        Args:
            function: Takes arrays (N, k) and returns one (N, j).
            *widths: Numbers k in a row of each argument.
            sound: Whether comparisons may drop a NaN.
            max_operations: Largest number of operations.
            fixed: How many of the first numbers the C takes in any case; it takes of the others
                those that it reads. None for all.

        Raises:
            NotCompilable: The function does more than arithmetic.
        """
        trace, taken = Trace(max_operations, sound), sum(widths)
        whole = trace.read("x[{}][i]", np.arange(taken)[None])
        ends = np.cumsum([0, *widths])
        with symbolic():
            result = function(*(whole[:, a:b] for a, b in zip(ends, ends[1:], strict=False)))[0]
        self.trace, self.result = trace, result
        """The recorded operations, and the symbols or numbers (j,) that they give."""
        self.width = len(result)
        """Numbers j in a row of its result."""
        body = trace.body({f"y[{k}][i]": value for k, value in enumerate(result)})
        read = {int(k) for k in re.findall(r"\bx\[(\d+)\]", body)}
        kept = range(taken) if fixed is None else sorted(read.union(range(fixed)))
        self.places = {number: place for place, number in enumerate(kept)}
        """Where the C takes each of the numbers."""
        self.body = re.sub(r"\bx\[(\d+)\]", lambda found: f"x[{self.places[int(found[1])]}]", body)
        """C of its operations, from x[k][i] to y[k][i], with its constants in c."""
        self.taken = len(self.places)
        """How many numbers the C takes."""
        self.constants = np.array([*trace.constants, 0.0])
        count, kept = len(self.constants), "const double* c = constants;"
        if count <= COPIED:
            kept = f"double c[{count}];\n  memcpy(c, constants, sizeof c);"
        export = (Path(compiling.__file__).parent / "export.h").read_text()
        whole = self._function("compute", "QUADRL_EXPORT", kept)
        sizes = {"taken": self.taken, "given": self.width}
        self.source = SOURCE.format(export=export, function=whole, **sizes)
        """Its C, without the constants."""

    def depends(self, places: set[int]) -> list[bool]:
        """Which numbers of its result depend on arguments at some places."""
        known: set[Any] = set()
        for symbol in self.trace.known.values():
            read = re.match(r"x\[(\d+)\]", symbol.text)
            if int(read[1]) in places if read else not known.isdisjoint(symbol.operands):
                known.add(symbol)
        return [value in known for value in self.result]

    def _function(self, name: str, linkage: str, constants: str) -> str:
        names = {"name": name, "linkage": linkage, "constants": constants}
        return FUNCTION.format(body=self.body, **names)

    def text(self, name: str) -> str:
        """Its C as the function of a name for LANES rows, its constants written out in it."""
        texts = [
            k.hex() if math.isfinite(k) else WITHOUT_HEX[str(k)] for k in self.constants.tolist()
        ]
        body = re.sub(r"\bc\[(\d+)\]", lambda found: f"({texts[int(found[1])]})", self.body)
        known = f"static const double {name}_constants[] = {{{', '.join(texts)}}};"
        if not re.search(r"\bc\[", body):  # nothing is looked up
            known = ""
        given = f"const double* c = {name}_constants;" if known else "const double* c = 0;"
        names = {"name": name, "linkage": "static", "constants": f"(void)constants;\n  {given}"}
        return known + FUNCTION.format(body=body, **names)

    def load(self) -> Any:
        """The C function, compiled unless it is in the cache.

        Raises:
            NativeError: There is no compiler, or it refused the source.
        """
        run = compiling.compile_generated(self.source).run
        run.argtypes = [*3 * (ctypes.c_void_p,), ctypes.c_int64, ctypes.c_void_p]
        run.restype = None
        return run

    def struct(self) -> np.ndarray:
        """It as `Function` in native/free_flight.c.

        Raises:
            NativeError: There is no compiler, or it refused the source.
        """
        compute = ctypes.cast(compiling.compile_generated(self.source).compute, ctypes.c_void_p)
        return native.struct(compute.value, self.constants, self.taken, self.width)

    def on(self, *arrays: np.ndarray, results: int = 1) -> Callable[..., None]:
        """The function bound to arrays, whose numbers may change but not their places in memory.

        Args:
            *arrays: Its arguments and then its result, float64, each row contiguous; the result may
                stand in the same place as an argument.
            results: In how many arrays the numbers of the result stand, one after the other.

        Returns:
            Computes the rows of a list (n,) int64, or all.

        Raises:
            NativeError: There is no compiler, or it refused the source.
        """
        compiled = self.load()
        first, places = 0, list[list[int]]()
        for array in arrays[:-results]:
            taken = [k for k in range(array.shape[1]) if first + k in self.places]
            stride, first = array.strides[0] // 8, first + array.shape[1]
            # A piece for each run of numbers that the C takes.
            for k in taken:
                if k - 1 in taken:
                    places[-1][2] += 1
                else:
                    places.append([array.ctypes.data + 8 * k, stride, 1])
        given = [[a.ctypes.data, a.strides[0] // 8, a.shape[1]] for a in arrays[-results:]]
        kept = arrays, np.array(places), np.array(given), self.constants
        taken, given, constants = (array.ctypes.data for array in kept[1:])
        count = len(arrays[0])

        def run(rows: np.ndarray | None = None, kept: Any = kept) -> None:  # keeps them alive
            some = (count, None) if rows is None else (len(rows), rows.ctypes.data)
            compiled(constants, taken, given, *some)

        return run

    def __call__(self, *arrays: np.ndarray) -> np.ndarray:
        """The result (N, j) for arrays (N, k)."""
        found = np.empty((len(arrays[0]), self.width))
        given = (np.ascontiguousarray(array, dtype=np.float64) for array in arrays)
        self.on(*given, found)()
        return found


def reverse(function: Callable[..., Array]) -> Callable[..., Array]:
    """The function of the derivatives of a scalar by a function's arguments (N, sum of k).

    It takes those arguments, and the derivatives (N, j) of the scalar by the function's result.
    """

    def back(*given: Any) -> Array:
        *arguments, by = given
        leaves = [leaf for argument in arguments for leaf in argument[0]]
        results = function(*arguments)[0]
        found = leaves[0].trace.vector_jacobian_product(results, by[0], leaves)
        return symbols(found)[None]

    return back

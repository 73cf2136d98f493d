"""The tracer: it turns pure functions of arrays into C, and differentiates them in reverse.

A function that never branches on data does the same operations for every row. Called with arrays
of symbols in place of numbers, it records the operations of one row, which become the body of a
loop over rows. They are NumPy's own, in the same order, so that the compiled loop gives the same
bits (except for sine and the like, which are the C library's).
"""

# pyright: standard
# Symbols stand for arrays of any kind, and the functions of a task for anything callable.
from __future__ import annotations

import contextlib
import functools
from collections.abc import Generator, Iterable, Mapping
from typing import Any

import numpy as np

from quadrl.base.operations import ARRANGING, FLAGS, LOGICAL, REVERSE, SOUND, C
from quadrl.base.rotation import Array, namespace

MAX_OPERATIONS = 8000  # more would take the C compiler longer than they save
MAX_TABLES = 1_000_000
"""Largest number of entries of all tables in which a function looks up values."""


class NotCompilable(TypeError):
    """A traced function does more than arithmetic, or reads a value that may change."""


@contextlib.contextmanager
def symbolic() -> Generator[None]:
    """Raise `NotCompilable` for any error of a function that has run with numbers before."""
    try:
        yield
    except NotCompilable:
        raise
    except Exception as error:  # NumPy, other libraries and the caller each have their own
        reason = f"with symbols it raises {type(error).__name__}: {error}"
        raise NotCompilable(reason) from error


class Symbol:
    """A number that is known when the loop runs; equal operations give the same symbol."""

    def __init__(
        self, trace: Trace, text: str, operation: str, operands: tuple[Any, ...], is_flag: bool
    ) -> None:
        """Name the value of a C expression: an operation on symbols, or a read from memory."""
        self.trace, self.text, self.is_flag = trace, text, is_flag
        self.operation, self.operands = operation, operands
        self.name = f"t{len(trace.known)}"

    def __bool__(self) -> bool:
        raise NotCompilable("a branch on data cannot be compiled")

    __eq__ = __ne__ = lambda self, other: bool(self)  # of lists, for instance
    __hash__ = object.__hash__


class Trace:
    """The recorded operations of one row, in order."""

    def __init__(self, max_operations: float = MAX_OPERATIONS, sound: bool = False) -> None:
        """Begin with no operations.

        Args:
            max_operations: Largest number of operations.
            sound: Whether `maximum` and `minimum` may return either operand where one is NaN.
        """
        self._texts = C | SOUND if sound else C
        self.known: dict[tuple[str, ...], Symbol] = {}
        self.max_operations = max_operations
        self.constants: list[float] = []
        self._tables: dict[bytes, int] = {}

    def inputs(self, expressions: Array, is_flag: bool = False) -> Symbols:
        """Symbols of C expressions that read memory, in an array of any shape."""

        def read(text: str) -> Symbol:
            return self.known.setdefault((text,), Symbol(self, text, "", (), is_flag))

        return symbols(np.frompyfunc(read, 1, 1)(expressions))

    def read(self, place: str, numbers: Array) -> Symbols:
        """Symbols of numbers in memory, by a C expression with {} for the index of each."""
        return self.inputs(np.frompyfunc(lambda number: place.format(int(number)), 1, 1)(numbers))

    def operation(self, name: str, *values: Any) -> Symbol:
        """Record an operation and return the symbol of its result.

        Raises:
            NotCompilable: The operation has no C, or there are too many operations.
        """
        if name == "clip":
            name, values = "minimum", (self.operation("maximum", *values[:2]), values[2])
        elif name == "square" or (name == "power" and _is_two(values[1])):
            name, values = "multiply", (values[0], values[0])
        flags = [_is_flag(value) for value in values]
        known = flags[0] if name == "where" else all(flags) == (name in LOGICAL)
        if len(self.known) > self.max_operations:
            raise NotCompilable(f"it needs more than {self.max_operations} operations")
        if name not in C or not known:
            raise NotCompilable(f"{name} cannot be compiled")
        names = tuple(self.name_of(value) for value in values)
        is_flag = name in FLAGS or (name == "where" and all(flags))
        symbol = Symbol(self, self._texts[name].format(*names), name, values, is_flag)
        return self.known.setdefault((name, *names), symbol)

    def look_up(self, table: np.ndarray, index: Symbol) -> list[Symbol]:
        """Symbols (k,) of the entry of a table (n, k) at an index from 0 to n - 1.

        Raises:
            NotCompilable: The tables are too large.
        """
        first = self._tables.setdefault(table.tobytes(), len(self.constants))
        if first == len(self.constants):
            self.constants += table.ravel().tolist()
        if len(self.constants) > MAX_TABLES:
            reason = f"its look-ups need {len(self.constants)} numbers, more than {MAX_TABLES}"
            raise NotCompilable(f"{reason}, which cannot be compiled")
        count = table.shape[1]
        found: list[Symbol] = []
        for place in range(first, first + count):
            text = f"c[{place} + {count} * (int64_t){index.name}]"
            symbol = Symbol(self, text, "look_up", (index,), is_flag=False)
            found.append(self.known.setdefault((text,), symbol))
        return found

    def name_of(self, value: Any) -> str:
        """The name of an operand in C; numbers are constants, so that options change no code."""
        if isinstance(value, Symbol):
            return value.name
        if _is_flag(value):
            return str(int(value))
        self.constants.append(float(value))
        return f"c[{len(self.constants) - 1}]"

    def vector_jacobian_product(
        self, results: Iterable[Any], given: Iterable[Any], arguments: Iterable[Any]
    ) -> list[Any]:
        """The derivatives of a scalar by symbols of the trace.

        A function that is defined piece by piece has the derivative of the piece in use.

        Args:
            results: Symbols and numbers on which the scalar depends.
            given: The derivatives of the scalar by each result.
            arguments: Symbols to differentiate by, in any order.

        Raises:
            NotCompilable: An operation has no derivative here.
        """
        by: dict[Any, Symbols] = {}

        def add(values: Iterable[Any], derivatives: Iterable[Any]) -> None:
            for value, more in zip(values, derivatives, strict=True):
                if isinstance(value, Symbol) and not value.is_flag and more is not None:
                    by[value] = by[value] + more if value in by else symbols(more)

        add(results, given)
        for symbol in reversed(list(self.known.values())):
            if symbol in by and symbol.operands:
                if symbol.operation not in REVERSE:
                    raise NotCompilable(f"{symbol.operation} has no derivative here")
                operands = map(symbols, symbol.operands)
                derivatives = REVERSE[symbol.operation](by[symbol], symbols(symbol), *operands)
                add(symbol.operands, derivatives)
        return [by[symbol].item() if symbol in by else 0.0 for symbol in arguments]

    def body(self, outputs: Mapping[str, Any]) -> str:
        """C that computes outputs, given by the expressions of the memory that they go to.

        It reads memory first, and stores each output at once, which frees its register.
        """
        stores: dict[str, list[str]] = {}
        for place, value in outputs.items():
            name = self.name_of(value)
            stores.setdefault(name, []).append(f"{place} = {name};")
        used, reads, operations = set(stores), [], []
        for symbol in reversed(self.known.values()):
            if symbol.name in used:  # directly or indirectly, by an output
                used.update(x.name for x in symbol.operands if isinstance(x, Symbol))
                kind = "int" if symbol.is_flag else "double"
                line = f"const {kind} {symbol.name} = {symbol.text};"
                if symbol.operands:
                    operations += [*stores.pop(symbol.name, []), line]
                else:
                    reads.append(line)
        rest = [line for lines in stores.values() for line in lines]
        return "\n    ".join(reads[::-1] + operations[::-1] + rest)


class Symbols(np.ndarray):
    """An array of symbols and numbers that NumPy's functions take as they take any array."""

    def __array_ufunc__(self, ufunc: Any, method: str, *inputs: Any, **options: Any) -> Any:
        """Record an operation for each element."""
        if method == "__call__" and not any(x is not None for x in options.values()):
            return elementwise(ufunc.__name__, *inputs)
        if ufunc.__name__ in LOGICAL and options.get("dtype") in (bool,):
            options["dtype"] = None  # `any` and `all`
        rest = (options[name] for name in options.keys() - {"axis", "keepdims"})
        usual, axes = all(x is None or x is True for x in rest), options.get("axis", 0)
        if axes is None:
            raise NotCompilable("a look at all rows at once cannot be compiled")
        axes = axes if isinstance(axes, tuple) else (axes,)
        whole = np.moveaxis(np.asarray(inputs[0]), axes, range(len(axes)))
        parts = whole.reshape(-1, *whole.shape[len(axes) :])
        # Over several axes, and from 8 numbers on, NumPy adds in another order.
        in_order = ufunc is not np.add or (len(axes) == 1 and len(parts) < 8)
        if method == "reduce" and usual and in_order:
            result = functools.reduce(functools.partial(elementwise, ufunc.__name__), parts)
            return np.expand_dims(result, axes) if options.get("keepdims") else result
        raise NotCompilable(f"{ufunc.__name__}.{method} cannot be compiled")

    def __array_function__(self, function: Any, types: Any, args: Any, options: Any) -> Any:
        """Record `where`, or rearrange symbols."""
        if function is np.where:
            return elementwise("where", *args)
        if function not in ARRANGING:
            raise NotCompilable(f"{function.__module__}.{function.__name__} cannot be compiled")
        result = super().__array_function__(function, types, args, options)
        return symbols(result) if isinstance(result, np.ndarray) else result


def symbols(array: Any) -> Symbols:
    """An array of objects as symbols."""
    return np.asarray(array, dtype=object).view(Symbols)


def elementwise(name: str, *arrays: Any) -> Symbols:
    """An operation on each element of arrays that are broadcast."""

    def operate(*operands: Any) -> Any:
        trace = next((x.trace for x in operands if isinstance(x, Symbol)), None)
        if trace is None:  # numbers alone, as NumPy computes them
            return getattr(np, name)(*operands)
        return trace.operation(name, *operands)

    plain = (np.asarray(array, dtype=object) for array in arrays)
    return symbols(np.frompyfunc(operate, len(arrays), 1)(*plain))


def look_up(table: np.ndarray, index: Array) -> Array:
    """Entries of a constant table, in any array namespace, and in a step that is compiled.

    Args:
        table: Numbers (n, ...), at least one entry.
        index: Whole numbers (...) from 0 on, held as floats. A larger index gives the last entry;
            a smaller one, or NaN, gives the first.

    Returns:
        Numbers (..., *table.shape[1:]) of the index's dtype.
    """
    table, xp = np.array(table, dtype=np.float64), namespace(index)
    last = float(len(table) - 1)
    place = xp.where(index > 0, xp.where(index < last, index, last), 0.0)
    if not isinstance(place, Symbols):
        entries = xp.asarray(table, dtype=place.dtype, device=place.device)
        return entries[xp.asarray(place, dtype=xp.int64)]
    flat = table.reshape(len(table), -1)
    found = [
        x.trace.look_up(flat, x) if isinstance(x, Symbol) else flat[int(x)] for x in place.flat
    ]
    return symbols(found).reshape(*place.shape, *table.shape[1:])


def _is_two(value: Any) -> bool:
    return not isinstance(value, Symbol) and value == 2


def _is_flag(value: Any) -> bool:
    return value.is_flag if isinstance(value, Symbol) else isinstance(value, (bool, np.bool_))

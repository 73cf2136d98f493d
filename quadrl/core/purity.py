"""What functions read besides their arguments, found by a look at their code.

A compiled step keeps what its functions read when they were traced. Functions, classes and modules
are taken as fixed, those of some libraries as functions of their arguments alone. A number or a
text is watched, since its name may be given another value. Everything else may change unnoticed,
and a step that reads it is not compiled.
"""

# pyright: standard
# What it looks at is anything that a function may name.
from __future__ import annotations

import dataclasses
import dis
import enum
import functools
import reprlib
import sys
import types
from collections.abc import Callable, Iterable, Mapping
from typing import Any

import numpy as np

from quadrl.base.trace import NotCompilable

TRUSTED = {
    "array_api_compat", "builtins", "cmath", "collections", "copy", "dataclasses", "difflib",
    "enum", "functools", "itertools", "math", "numbers", "numpy", "operator", "reprlib", "torch",
    "types", "typing",
}  # fmt: skip
"""Packages whose functions are not looked into, since they read nothing but their arguments."""
READING = (
    "numpy.random", "numpy.fromfile", "numpy.fromregex", "numpy.genfromtxt", "numpy.get",
    "numpy.load", "numpy.memmap", "torch.get", "torch.load", "torch.rand",
)  # fmt: skip
"""What the names of those begin with that do read something else: files, settings, a state."""
REFUSED = {*sys.stdlib_module_names, "numpy", "torch"} - {"abc"}
"""Packages whose other functions are refused; tasks that `type` makes call themselves abc's."""
PLAIN = (int, float, complex, str, bytes, type(None), type(...), np.generic, np.dtype, enum.Enum)
DESCRIPTORS = (types.MemberDescriptorType, types.GetSetDescriptorType)
BY_NAME = {"globals", "vars", "eval", "exec", "open", "__import__", "import"}
"""What is built in and reads what a look at the code cannot tell."""
CALLED = {"__new__", "__init__", "__post_init__", "__call__"}
"""What a call of a class or of an object runs."""
Place = tuple[Mapping[str, Any], bool]
"""Names with their values, and whether the values are watched."""


class Reads:
    """All that some methods of an object look up, and the functions that they call."""

    def __init__(self, owner: Any, methods: Iterable[str], kinds: Iterable[type] = ()) -> None:
        """Look everything up.

        Args:
            owner: A frozen dataclass.
            methods: Names of its methods; those of its base classes count too.
            kinds: Classes of what the methods are given, whose properties count too.

        Raises:
            NotCompilable: Something may change; the message names it.
        """
        self._watched: list[tuple[str, Callable[[str], Any], str, Any]] = []
        self._seen: set[int] = set()
        self._own = vars(owner)
        self._places = [p for kind in (type(owner), *kinds) for p in _inside(kind)]
        self._look(set(methods), [])

    @property
    def changed(self) -> str:
        """The first name that has another value by now; empty where none has."""
        for name, read, key, value in self._watched:
            if read(key) is not value:
                return name
        return ""

    def _look(self, names: set[str], places: list[tuple[Place, set[str]]]) -> None:
        """Look names up in some places, and all as attributes of the owner and of what is found."""
        for name in names & self._own.keys():
            self._judge(f"self.{name}", self._own[name])
        inherited = names - self._own.keys()  # the class has the defaults of options
        found: set[int] = set()
        todo = [*places, *((place, inherited) for place in self._places)]
        for (place, watched), wanted in todo:  # which grows
            for name in wanted & place.keys():
                value = place[name]
                self._judge(name, value)
                if watched and isinstance(value, (*PLAIN, tuple, frozenset)):
                    self._watched.append((name, place.get, name, value))
                if id(value) not in found:
                    found.add(id(value))
                    todo += [(inside, names) for inside in _inside(value)]

    def _judge(self, name: str, value: Any) -> None:
        """Refuse what may change; look into functions, and into what fixed objects are made of."""
        if isinstance(value, PLAIN) or id(value) in self._seen or _trusted(value):
            return
        self._seen.add(id(value))
        own = _full_name(value).partition(".")[0] not in REFUSED
        if own and isinstance(value, types.FunctionType):
            self._look_into(value)
        elif own and isinstance(value, type):
            for member in CALLED & vars(value).keys():
                self._judge(f"{name}.{member}", vars(value)[member])
        else:
            for part in _parts(name, value):
                self._judge(name, part)

    def _look_into(self, function: types.FunctionType) -> None:
        """Look up what a function names: globals, attributes, its closure and its defaults."""
        names, codes = set[str](), [function.__code__]
        if function.__name__ in CALLED and codes[0].co_filename == "<string>":
            return  # what `dataclasses` writes
        for code in codes:  # which grows by the functions in it
            names |= {*code.co_names}
            codes += [x for x in code.co_consts if isinstance(x, types.CodeType)]
        if "getattr" in names:
            names |= {x for code in codes for x in code.co_consts if isinstance(x, str)}
        loaded, known = set[str]().union(*map(_loaded, codes)), function.__globals__
        if unseen := loaded & BY_NAME - known.keys():
            raise NotCompilable(f"{function.__qualname__} uses {min(unseen)}")
        self._look(names, [((known, True), loaded)])
        cells = zip(function.__code__.co_freevars, function.__closure__ or (), strict=True)
        for name, cell in cells:
            if name != "__class__":  # that of `super()`
                value = cell.cell_contents
                self._judge(name, value)
                self._watched.append((name, cell.__getattribute__, "cell_contents", value))
        for default in (*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values()):
            self._judge(f"a default of {function.__qualname__}", default)


@functools.cache
def _loaded(code: types.CodeType) -> set[str]:
    """Names of globals that code looks up, and "import" where it imports some."""
    steps = [*dis.get_instructions(code)]
    imports = {"import" for step in steps if step.opname == "IMPORT_NAME"}
    return imports | {x.argval for x in steps if x.opname in ("LOAD_GLOBAL", "LOAD_NAME")}


def _full_name(value: Any) -> str:
    """Module and name of a function or class; empty where what it is bound to says more."""
    module = getattr(value, "__module__", None)
    functions = types.FunctionType, types.BuiltinMethodType
    if isinstance(value, functools.partial) or (isinstance(value, functions) and not module):
        return ""
    # C has modules with an underscore for Python's.
    return f"{module or type(value).__module__}.{getattr(value, '__name__', '')}".lstrip("_")


def _trusted(value: Any) -> bool:
    name = _full_name(value) if callable(value) else ""
    return name.partition(".")[0] in TRUSTED and not name.startswith(READING)


def _inside(value: Any) -> list[Place]:
    """Where the attributes of a module, a class or a fixed object stand."""
    if isinstance(value, types.ModuleType):
        return [(vars(value), value.__name__.partition(".")[0] not in TRUSTED)]
    kind = value if isinstance(value, type) else type(value) if _is_fixed(value) else object
    return [(vars(base), True) for base in kind.__mro__ if not _trusted(base)]


def _is_fixed(value: Any) -> bool:
    settings = getattr(type(value), "__dataclass_params__", None)
    return settings is not None and settings.frozen


def _parts(name: str, value: Any) -> Iterable[Any]:
    """What is called or read through an object.

    Raises:
        NotCompilable: It may change.
    """
    if isinstance(value, (tuple, frozenset)):
        return value
    if _is_fixed(value):
        return [getattr(value, field.name) for field in dataclasses.fields(value)]
    read_only = isinstance(value, np.ndarray) and not value.flags.writeable
    if read_only or isinstance(value, (types.ModuleType, *DESCRIPTORS)):
        return ()
    if isinstance(value, functools.partial):
        return value.func, *value.args, *value.keywords.values()
    if isinstance(value, types.BuiltinMethodType) and not _full_name(value):
        return (value.__self__,)
    if isinstance(value, types.MethodType):
        return value.__func__, value.__self__
    if isinstance(value, (property, functools.cached_property)):
        return (value.fget if isinstance(value, property) else value.func,)
    if (wrapped := getattr(value, "__wrapped__", None)) is not None:
        return (wrapped,)
    advice = "make it an option of the task"
    raise NotCompilable(f"it reads {name}, {reprlib.repr(value)}, which may change; {advice}")

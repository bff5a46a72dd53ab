"""The package's own objects as files: arrays, and a description of what they are part of.

A file is a zip of numpy's arrays (`.npz`) with a document in JSON that says how they make up
objects. Nothing in it is executed: classes are looked up by name, in this package only, and each is
made in the one way in which such classes are written. A digest finds what was changed by accident;
it is no signature.

What is read nobody has checked: objects must be what the annotations of their classes say, in kinds
and in sizes of arrays. Axes of one name have one length within an object.
"""

from __future__ import annotations

import base64
import dataclasses
import enum
import importlib
import importlib.metadata
import sys
import types
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any, Union, get_args, get_origin

import jax
import numpy as np
from jaxtyping import AnnotationError, jaxtyped

from reachjax.numerics.archives import UnreadableError, digest, read_archive, write_archive
from reachjax.numerics.pytrees import PACKAGE, is_own, unchecked


def require_structure(kind: type, fields: dict[str, Any]) -> None:
    """Raise an error unless values are what a class says of its fields of these names.

    Args:
        kind: a dataclass or a named tuple.
        fields: their values.

    Raises:
        ValueError: one is something else, or arrays disagree in the length of an axis.

    Example:
        >>> import numpy as np
        >>> from reachjax.sets import NormalForm
        >>> require_structure(NormalForm, {"A": np.eye(2), "b": np.ones(2)})
        >>> require_structure(NormalForm, {"A": np.eye(2), "b": np.ones(3)})
        Traceback (most recent call last):
        ...
        ValueError: its NormalForm.b must be of shape (n), but ndarray of shape (3,) arrived
    """
    hints = _hints(kind)
    with jaxtyped("context"):  # pyright: ignore[reportGeneralTypeIssues]
        for name, value in fields.items():
            hint = hints.get(name, Any)
            if not _fits(value, hint):
                shape = f" of shape {value.shape}" if hasattr(value, "shape") else ""
                raise ValueError(
                    f"its {kind.__name__}.{name} must be of {_told(hint)}, but "
                    f"{type(value).__name__}{shape} arrived"
                )


@cache
def _hints(kind: type) -> dict[str, Any]:
    """What a class and those above it say of their fields, as far as it can be looked up here."""
    found = {}
    for each in reversed(kind.__mro__):
        names = vars(sys.modules[each.__module__])
        for name, given in vars(each).get("__annotations__", {}).items():
            text = getattr(given, "__forward_arg__", given)
            try:
                found[name] = eval(text, names) if isinstance(text, str) else text
            except (NameError, TypeError):  # imported for the type checker alone
                found[name] = Any
    return found


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is what an annotation says; one of an unknown form says nothing."""
    origin, parts = get_origin(hint), get_args(hint)
    if hint is None:
        return value is None
    if origin in (Union, types.UnionType):
        return any(_fits(value, each) for each in parts)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if parts[-1] is Ellipsis:
            return all(_fits_alone(each, parts[0]) for each in value)
        return len(parts) == len(value) and all(map(_fits, value, parts))
    known = hint if origin is None else origin
    if not isinstance(known, type):
        return True
    try:
        return isinstance(value, known)
    except AnnotationError:  # a sum of axes, which is known from no other array
        return True
    except TypeError:  # a protocol that cannot be asked
        return True


def _fits_alone(value: Any, hint: Any) -> bool:
    """Whether a value is of its annotation where the axes of each array have their own lengths."""
    with jaxtyped("context"):  # pyright: ignore[reportGeneralTypeIssues]
        return _fits(value, hint)


def _told(hint: Any) -> str:
    """An annotation in words."""
    parts = [hint] if get_origin(hint) not in (Union, types.UnionType) else get_args(hint)
    names = (getattr(part, "dim_str", None) for part in parts)
    shapes = dict.fromkeys(name.strip() for name in names if name is not None)
    if shapes:
        return " or ".join(f"shape ({name.replace(' ', ', ')})" for name in shapes)
    return " or ".join(getattr(part, "__name__", str(part)) for part in parts)


VERSION = 1
"""The version of the format: files of another one are refused."""

SEAL = "seal"
"""A field with a hash of all others, which differs where another version writes them otherwise."""

MOVED = {
    "reachjax.loops.formats": "reachjax.loops.readers",
    "reachjax.loops.functions": "reachjax.loops.tracing.functions",
    "reachjax.loops.residual": "reachjax.loops.networks",
    "reachjax.loops.switching": "reachjax.loops.networks",
    "reachjax.loops.units.clip": "reachjax.loops.units.piecewise",
    "reachjax.loops.units.hard_tanh": "reachjax.loops.units.piecewise",
    "reachjax.loops.units.leaky_relu": "reachjax.loops.units.piecewise",
    "reachjax.loops.units.relu": "reachjax.loops.units.piecewise",
    "reachjax.loops.units.exponential": "reachjax.loops.units.powers",
    "reachjax.loops.units.hyperbolic": "reachjax.loops.units.saturating",
    "reachjax.loops.units.within": "reachjax.loops.units.powers",
    "reachjax.proofs.cells": "reachjax.proofs.by_forms",
    "reachjax.proofs.linear": "reachjax.proofs.by_forms",
    "reachjax.proofs.ellipsoids": "reachjax.proofs.by_products",
    "reachjax.proofs.facets": "reachjax.proofs.by_products",
    "reachjax.proofs.mixed": "reachjax.proofs.by_products",
    "reachjax.sets.box": "reachjax.sets.base",
    "reachjax.sets.normal_form": "reachjax.sets.base",
    "reachjax.sets.ellipsoid_template": "reachjax.sets.templates",
    "reachjax.sets.mixed_template": "reachjax.sets.templates",
    "reachjax.sets.template": "reachjax.sets.templates",
    "reachjax.tubes.kept": "reachjax.tubes.saving",
}
"""Modules, and folders of them, that files written earlier name otherwise."""

PLAIN = bool | int | float | str | None


class UnstorableError(Exception):
    """An object is none of the package's, such as a function that a user wrote."""


class Writer:
    """Objects on their way into a file; what is there more than once is written once.

    Args:
        outside: a class whose objects are left out where they cannot be stored.

    Attributes:
        arrays: so far.
        left_out: whether an object of that class was.
    """

    def __init__(self, outside: type):
        self.arrays: list[np.ndarray] = []
        self.left_out = False
        self._outside = outside
        self._known: dict[int, tuple[Any, int]] = {}
        self._numbers: dict[str, int] = {}

    def described(self, value: Any) -> Any:
        """A value as plain data, its arrays by their numbers.

        Raises:
            UnstorableError: it holds an object that is none of the package's.
        """
        if isinstance(value, enum.Enum):
            return {"enum": _name(type(value)), "member": value.name}
        if value is None or isinstance(value, PLAIN):
            return value
        if isinstance(value, bytes):
            return {"bytes": base64.b64encode(value).decode()}
        if isinstance(value, np.ndarray | np.generic | jax.Array):
            return {"array": self._placed(value), "on": "device" * isinstance(value, jax.Array)}
        if isinstance(value, self._outside):
            held = len(self.arrays), dict(self._known), dict(self._numbers)
            try:
                return self._object(value)
            except UnstorableError:  # nor are its arrays, if nothing else has them
                del self.arrays[held[0] :]
                _, self._known, self._numbers = held
                self.left_out = True
                return {"outside": _name(type(value))}
        if isinstance(value, tuple) and hasattr(value, "_fields"):
            parts = [self.described(each) for each in value]
            return {"named": _name(type(value)), "parts": parts}
        if isinstance(value, tuple | list):
            return {type(value).__name__: [self.described(each) for each in value]}
        if isinstance(value, Mapping):
            items = [[self.described(key), self.described(each)] for key, each in value.items()]
            return {"mapping": items}
        if hasattr(type(value), "stored"):
            return {"stored": _name(type(value)), "as": self.described(value.stored())}
        if dataclasses.is_dataclass(value):
            return self._object(value)
        raise UnstorableError(f"{value!r} cannot be stored")

    def _placed(self, array: Any) -> int:
        if id(array) not in self._known:
            held = np.asarray(array)
            number = self._numbers.setdefault(digest(None, [held]), len(self.arrays))
            self._known[id(array)] = array, number  # kept alive: no other one has its place
            if number == len(self.arrays):
                self.arrays.append(held)
        return self._known[id(array)][1]

    def _object(self, value: Any) -> Any:
        fields = {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
        found = {name: self.described(each) for name, each in fields.items()}
        return {"object": _name(type(value)), "fields": found}


def _name(kind: type) -> str:
    """A class of the package by name.

    Raises:
        UnstorableError: it is another one.
    """
    if not is_own(kind.__module__):
        raise UnstorableError(f"{kind.__qualname__} of {kind.__module__} cannot be stored")
    return f"{kind.__module__}:{kind.__qualname__}"


def _class(name: str) -> Any:
    """A class that this package defines, by name; what it merely imports is none of its own."""
    if not isinstance(name, str):
        raise ValueError(f"it names a class by {name!r:.60}")
    module, _, path = name.partition(":")
    if not is_own(module):
        raise ValueError(f"it names {name}, which is not of {PACKAGE}")
    try:
        found = importlib.import_module(_moved(module))
        for part in path.split("."):
            found = getattr(found, part)
    except (ImportError, AttributeError):
        raise ValueError(f"it names {name}, which this {PACKAGE} does not have") from None
    if not isinstance(found, type):
        raise ValueError(f"it names {name}, which is no class")
    if not is_own(found.__module__) or found.__qualname__ != path:
        raise ValueError(f"it names {name}, which is not of {PACKAGE}")
    return found


def _moved(module: str) -> str:
    """The name of a module today, as `MOVED` has it for itself or for its folder."""
    folder, _, last = module.rpartition(".")
    if folder in MOVED:
        module = f"{MOVED[folder]}.{last}"
    return MOVED.get(module, module)


def _enumeration(name: str) -> type[enum.Enum]:
    found = _class(name)
    if not issubclass(found, enum.Enum):
        raise ValueError(f"it names {name}, which is no enumeration")
    return found


def _named_tuple(name: str) -> Any:
    found = _class(name)
    if not (issubclass(found, tuple) and hasattr(found, "_fields")):
        raise ValueError(f"it names {name}, which is no named tuple")
    return found


def _restorable(name: str) -> Any:
    found = _class(name)
    if not (hasattr(found, "stored") and hasattr(found, "restored")):
        raise ValueError(f"it names {name}, which is not stored so")
    return found


class Reader:
    """Objects on their way out of a file; what is there more than once is one object again.

    Args:
        arrays: by their numbers.
        outside: takes the place of objects that were left out.
    """

    def __init__(self, arrays: Sequence[np.ndarray], outside: Any):
        self._arrays, self._outside = arrays, outside
        self._known: dict[Any, tuple[Any, Any]] = {}

    def value(self, described: Any) -> Any:
        """The value of plain data.

        Raises:
            Exception: of any kind: it describes nothing that there is.
        """
        if described is None or isinstance(described, PLAIN):
            return described
        match described:
            case {"enum": name, "member": member}:
                return _enumeration(name)[member]
            case {"bytes": text}:
                return base64.b64decode(text)
            case {"array": number, "on": where}:
                return self._once("on" if where else "off", self._placed, number)
            case {"outside": _}:
                return self._outside
            case {"named": name, "parts": parts}:
                return self._once(_named_tuple(name), _named, *map(self.value, parts))
            case {"tuple": parts}:
                return self._once(tuple, _tuple, *map(self.value, parts))
            case {"list": parts}:
                return [*map(self.value, parts)]
            case {"mapping": items}:
                return {self.value(key): self.value(each) for key, each in items}
            case {"stored": name, "as": parts}:
                return self._once(_restorable(name), _restored, self.value(parts))
            case {"object": name, "fields": fields}:
                values = map(self.value, fields.values())
                return self._once((_class(name), *fields), _rebuilt, *values)
        raise ValueError(f"it describes {described!r:.60}, which is unknown")

    def _once(self, kind: Any, make: Callable[..., Any], *parts: Any) -> Any:
        """What is made of parts, the same if it was made of them before."""
        key = kind, *(repr(part) if isinstance(part, PLAIN) else id(part) for part in parts)
        if key not in self._known:
            self._known[key] = parts, make(kind, *parts)  # kept alive: no other one has their place
        return self._known[key][1]

    def _placed(self, where: str, number: int) -> Any:
        array = self._arrays[number]
        if array.dtype.kind == "f" and array.dtype != np.float64:
            raise ValueError(
                f"it has numbers of {array.dtype}, but proofs count float64's rounding"
            )
        return jax.device_put(array) if where == "on" else array


def _tuple(kind: Any, *parts: Any) -> tuple[Any, ...]:
    return parts


def _named(kind: Any, *parts: Any) -> Any:
    made = kind(*parts)
    require_structure(kind, made._asdict())
    return made


def _restored(kind: Any, parts: Any) -> Any:
    return kind.restored(parts)


def _is_same(array: Any, other: Any) -> bool:
    """Whether arrays have the same numbers; NaN is itself."""
    one, other = np.asarray(array), np.asarray(other)
    return one.shape == other.shape and np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def _rebuilt(named: tuple[Any, ...], *values: Any) -> Any:
    """An object as it was, down to the last bit, if a user might have made it.

    What a class has got since a file was written is as it is by default.
    """
    kind, *names = named
    if not hasattr(kind, "__dataclass_fields__"):
        raise ValueError(f"it names {kind.__qualname__}, which has no fields")
    known = dataclasses.fields(kind)
    plain = {f.name: f.default for f in known if f.default is not dataclasses.MISSING}
    made = {
        f.name: f.default_factory() for f in known if f.default_factory is not dataclasses.MISSING
    }
    fields = plain | made | dict(zip(names, values, strict=True))
    if differ := {f.name for f in known} ^ set(fields):
        raise ValueError(
            f"its {kind.__qualname__} has other fields than this version's: {sorted(differ)}"
        )
    require_structure(kind, fields)
    if SEAL not in fields:  # else the parts are checked where they are sealed again
        own = kind(**{f.name: fields[f.name] for f in known if f.init})
        for name, value in fields.items():
            if isinstance(value, np.ndarray | jax.Array) and not _is_same(
                value, getattr(own, name)
            ):
                raise ValueError(
                    f"its {kind.__qualname__}.{name} is {np.asarray(value).tolist()!r:.60}, which "
                    "no object of that kind has"
                )
    return unchecked(kind, **fields)


def write(path: Path, value: Any, outside: type) -> None:
    """Write a file; one that is there is replaced once the new one is whole.

    Args:
        path: of the file.
        value: of the package's own objects.
        outside: a class whose objects are left out where they cannot be stored.

    Raises:
        OSError: it cannot be written.
        UnstorableError: something else cannot be stored.
    """
    writer = Writer(outside)
    described = writer.described(value)
    head = {"format": PACKAGE, "version": VERSION, "release": _release(), "value": described}
    head |= {"left_out": writer.left_out, "digest": digest(described, writer.arrays)}
    write_archive(path, head, writer.arrays)


def _release() -> str:
    try:
        return importlib.metadata.version(PACKAGE)
    except importlib.metadata.PackageNotFoundError:
        return "of a checkout"


def read(path: Path, outside: Any, missing: str) -> Any:
    """What a file holds, each object being as its class says.

    Args:
        path: of the file.
        outside: takes the place of objects that were left out; None if there is none.
        missing: what to say if one is needed.

    Raises:
        UnreadableError: it is none of the package's, of another version, or broken; or something
            was left out that is not given.
    """
    head, arrays = _opened(path)
    if head.get("left_out") and outside is None:
        raise UnreadableError(f"{path} {missing}")
    try:
        return Reader(arrays, outside).value(head["value"])
    except Exception as error:  # whoever wrote it may have written anything
        raise UnreadableError(f"{path} cannot be read: {_said(error)}") from error


def _opened(path: Path) -> tuple[dict[str, Any], list[np.ndarray]]:
    """The document and the arrays of a file."""
    try:
        head, arrays = read_archive(path)
        if head.get("format") != PACKAGE:
            raise UnreadableError("its document is of another format")
        same = head.get("version") != VERSION or head.get("digest") == digest(head["value"], arrays)
    except Exception as error:  # one bit is enough for any of a dozen kinds of zip's and numpy's
        raise UnreadableError(
            f"{path} is no file that {PACKAGE} wrote, or it is cut off or broken: {_said(error)}"
        ) from error
    if head.get("version") != VERSION:
        raise UnreadableError(
            f"{path} is of version {head.get('version')!r:.20} of the format (written by {PACKAGE} "
            f"{head.get('release')!s:.20}), but this {PACKAGE} reads version {VERSION}"
        )
    if not same:
        raise UnreadableError(
            f"{path} was changed after it was written: what it says is not proved"
        )
    return head, arrays


def _said(error: Exception) -> str:
    return f"{type(error).__name__}: {error}" if not isinstance(error, ValueError) else f"{error}"

"""Whether objects are what the annotations of their classes say: kinds, and sizes of arrays.

It is for what is read from files, which nobody has checked. Axes of one name have one length within
an object.
"""

from __future__ import annotations

import sys
import types
from functools import cache
from typing import Any, Union, get_args, get_origin

from jaxtyping import AnnotationError, jaxtyped


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

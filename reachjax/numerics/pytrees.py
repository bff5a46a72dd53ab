"""Immutable dataclasses that are JAX pytrees and may check their fields when a user builds them.

`flax.struct.dataclass` runs `__post_init__` again whenever JAX rebuilds the object, with whatever
stands for a leaf at that moment (`None`, a shape, a stacked batch), so a check there would reject
`jax.vmap` over networks. Here JAX rebuilds objects without calling the constructor.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from enum import Enum
from typing import Any, Self, TypeVar, dataclass_transform

import jax
import numpy as np

from reachjax.numerics.flags import made_lenient

T = TypeVar("T")

INNER = "reachjax.programs.", "reachjax.loops.scenarios"
"""Whose objects are asked by thousands within a call that has opened its scope."""


def static(**kwargs: Any) -> Any:
    """A field that is part of the tree's structure: hashable, and a new value compiles anew."""
    return dataclasses.field(metadata={"static": True}, **kwargs)


def converted(*, converter: Callable[..., Any], **kwargs: Any) -> Any:
    """A field whose value passes through `converter(value, name=...)` in the constructor."""
    return dataclasses.field(metadata={"converter": converter}, **kwargs)


@dataclass_transform(field_specifiers=(static, converted), frozen_default=True)
def pytree(cls: type[T]) -> type[T]:
    """Make `cls` a frozen dataclass and a pytree; conversions and checks run for users only."""
    check = cls.__dict__.get("__post_init__", lambda self: None)

    def convert_and_check(self) -> None:
        for field, converter in converters:
            value = getattr(self, field.name)
            if not (value is None and field.default is None):
                name = f"{type(self).__name__}.{field.name}"
                object.__setattr__(self, field.name, converter(value, name=name))
        check(self)

    cls.__post_init__ = convert_and_check  # type: ignore[attr-defined]
    cls = dataclasses.dataclass(frozen=True, eq=False)(cls)
    fields = dataclasses.fields(cls)  # type: ignore[arg-type]
    converters = [(f, f.metadata["converter"]) for f in fields if "converter" in f.metadata]
    data = tuple(f.name for f in fields if not f.metadata.get("static"))
    meta = tuple(f.name for f in fields if f.metadata.get("static"))

    def flatten_with_keys(tree):
        children = [(jax.tree_util.GetAttrKey(name), getattr(tree, name)) for name in data]
        return children, tuple(getattr(tree, name) for name in meta)

    def unflatten(aux, children):
        return unchecked(cls, **dict(zip((*data, *meta), (*children, *aux), strict=True)))

    def fields_alone(self) -> dict[str, Any]:
        """What is pickled and copied: what is kept beside the fields is found again."""
        return {field.name: getattr(self, field.name) for field in fields}

    cls.__getstate__ = fields_alone  # type: ignore[attr-defined]
    jax.tree_util.register_pytree_with_keys(cls, flatten_with_keys, unflatten)
    return cls


DATA = str, bytes, int, float, complex, type(None), np.ndarray, np.generic, jax.Array, Enum
"""What is all that it shows."""

PACKAGE = __name__.partition(".")[0]


def is_own(module: str) -> bool:
    """Whether a module is of this package."""
    return module.partition(".")[0] == PACKAGE


def written_elsewhere(value: Any) -> bool:
    """Whether a class that is not of this package, or a function, is among the parts of a tree.

    Traced functions are none of them: their traces say what they compute.
    """
    kind = type(value)
    if isinstance(value, tuple | list) and kind.__module__ == "builtins":
        return any(map(written_elsewhere, value))
    if isinstance(value, dict):
        return any(map(written_elsewhere, value.values()))
    if isinstance(value, (*DATA, jax.ShapeDtypeStruct)):
        return False
    if not is_own(kind.__module__):
        return True
    fields = dataclasses.fields(value) if dataclasses.is_dataclass(value) else ()
    return any(written_elsewhere(getattr(value, field.name)) for field in fields)


def unchecked(cls: type[T], **values: Any) -> T:
    """An object with these fields as they are: they are known to be right."""
    made = object.__new__(cls)
    for name, value in values.items():
        object.__setattr__(made, name, value)
    return made


def overrides(kind: type, said: str) -> bool:
    """Whether a user's class changes something of that one it is derived from which says this.

    Args:
        kind: the class.
        said: the name of an attribute or a method.

    Example:
        >>> class Base:
        ...     steady = True
        ...     def value(self, t):
        ...         return 1
        >>> Moving = type("Moving", (Base,), {"__module__": "theirs", "value": lambda self, t: t})
        >>> overrides(Base, "steady"), overrides(Moving, "steady")
        (False, True)
    """
    names = {each: {*vars(each), *vars(each).get("__annotations__", ())} for each in kind.__mro__}
    rank = next(k for k, each in enumerate(names) if said in names[each])
    theirs = [each for each in kind.__mro__[:rank] if not is_own(each.__module__)]
    known = set[str]().union(*(names[each] for each in names if each not in theirs))
    changed = set[str]().union(*(names[each] for each in theirs)) & known
    return any(not name.startswith(("__", "_abc_")) for name in changed)


class Replaceable:
    """Copies with some fields changed, checked as a new object is.

    Public methods of what inherits from it heed none of JAX's strict flags (`flags`), but for
    forms, programs and scenarios, which nobody holds who is not called by something public.

    A class must not change a method that is `typing.final`, by its own or by another class that it
    is derived from: what is proved would not be about it. (Of a property that mark is lost.)
    """

    def __init_subclass__(cls, **given: Any):
        super().__init_subclass__(**given)
        for base in cls.__mro__[1:]:
            for name, method in vars(base).items():
                if getattr(method, "__final__", False) and getattr(cls, name) is not method:
                    raise TypeError(
                        f"{cls.__name__}.{name} must be that of {base.__name__}, which is final: "
                        f"what is proved would not be about {cls.__name__}. Change what {name} "
                        "calls, or the parts that it is made of"
                    )
        if not cls.__module__.startswith(INNER):
            made_lenient(cls)

    def replace(self, **changes: Any) -> Self:
        """A copy in which the named fields are replaced."""
        return dataclasses.replace(self, **changes)  # type: ignore[type-var]

    def _set(self, **values: Any) -> None:
        """Store converted fields from `__post_init__`, while the object is being built."""
        for name, value in values.items():
            object.__setattr__(self, name, value)

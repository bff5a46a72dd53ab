"""What static analysis has to be told of the package's docstrings and dataclasses.

`@pytree` makes a dataclass, whose fields may be made by `static` and `converted`; an example is a
section of doctests.
"""

from __future__ import annotations

import re

import griffe

FIELDS = ("converted", "static")


class Conventions(griffe.Extension):
    """Reads the package as its own helpers mean it."""

    def on_class_instance(self, *, cls: griffe.Class, **_) -> None:
        """A pytree is a dataclass."""
        for decorator in cls.decorators:
            if _last(decorator.value) == "pytree":
                decorator.value = griffe.ExprName("dataclasses.dataclass")

    def on_attribute_instance(self, *, attr: griffe.Attribute, **_) -> None:
        """A field has the default that its maker is given."""
        if isinstance(attr.value, griffe.ExprCall) and _last(attr.value.function) in FIELDS:
            given = {getattr(one, "name", None): one for one in attr.value.arguments}
            attr.value = given["default"].value if "default" in given else None

    def on_instance(self, *, obj: griffe.Object, **_) -> None:
        """`Example:` holds doctests, as `Examples:` does."""
        if obj.docstring is not None:
            obj.docstring.value = re.sub(r"(?m)^Example:$", "Examples:", obj.docstring.value)


def _last(expression: griffe.Expr | str | None) -> str:
    return str(expression).rsplit(".", 1)[-1].split("(")[0]

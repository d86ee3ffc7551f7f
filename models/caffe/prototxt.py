"""Protocol buffers' text format: ``name: "conv1"  convolution_param { pad: 4 kernel_size: 9 }``.

Nothing is known here of what fields there should be; whoever asks for a value says its type.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from models.errors import CaffeError

_TOKEN = re.compile(
    r"""(?P<space>\s+|\#[^\n]*)
      | (?P<string>"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*')
      | (?P<word>[A-Za-z_][\w.]*|[-+]?[\d.][\w.+-]*)
      | (?P<mark>[{}<>:,;\[\]])""",
    re.VERBOSE,
)
_CLOSING = {"{": "}", "<": ">"}
_DEEPEST = 20


@dataclass
class Message:
    """Fields in their order; ``where`` names the message in errors."""

    where: str
    values: dict[str, list[str]] = field(default_factory=dict)
    messages: dict[str, list[Message]] = field(default_factory=dict)

    def texts(self, name: str) -> list[str]:
        """All values of a field, as they were written (strings without their quotes)."""
        return self.values.get(name, [])

    def text(self, name: str, default: str = "") -> str:
        """The last value of a field."""
        return self.values.get(name, [default])[-1]

    def integers(self, name: str) -> list[int]:
        """All values of a field of whole numbers."""
        try:
            return [int(value, 0) for value in self.texts(name)]
        except ValueError as error:
            raise CaffeError(f"{self.where}: {name} is no whole number: {error}") from None

    def integer(self, name: str, default: int) -> int:
        """The last value of a field of whole numbers."""
        return (self.integers(name) or [default])[-1]

    def number(self, name: str, default: float) -> float:
        """The last value of a field of numbers."""
        value = self.text(name, repr(default))
        try:
            return float(value.rstrip("fF"))
        except ValueError:
            raise CaffeError(f"{self.where}: {name} is no number: {value!r}") from None

    def flag(self, name: str, default: bool) -> bool:
        """The last value of a field of truth values."""
        value = self.text(name, str(default)).lower()
        if value not in {"true", "false", "1", "0"}:
            raise CaffeError(f"{self.where}: {name} is neither true nor false: {value!r}")
        return value in {"true", "1"}

    def child(self, name: str) -> Message:
        """The last message of that name; an empty one when there is none."""
        return (self.messages.get(name) or [Message(f"{self.where}/{name}")])[-1]


def parse(text: str) -> Message:
    """Read a whole file; raises ``CaffeError`` with the line at which it makes no sense."""
    return _Parser(text).message("the net", "", 0)


class _Parser:
    def __init__(self, text: str) -> None:
        self._tokens: list[tuple[str, str, int]] = []
        at, line = 0, 1
        while at < len(text):
            match = _TOKEN.match(text, at)
            if match is None:
                raise CaffeError(f"line {line}: {text[at : at + 20]!r} is no prototxt")
            if match.lastgroup != "space":
                self._tokens.append((str(match.lastgroup), match[0], line))
            line += match[0].count("\n")
            at = match.end()
        self._end = ("end", "the end of the file", line)
        self._at = 0

    def _peek(self) -> tuple[str, str, int]:
        return self._tokens[self._at] if self._at < len(self._tokens) else self._end

    def _next(self) -> tuple[str, str, int]:
        token = self._peek()
        self._at += 1
        return token

    def message(self, where: str, closing: str, depth: int) -> Message:
        """Fields up to ``closing``, or to the end of the file."""
        if depth > _DEEPEST:
            raise CaffeError(f"{where}: messages lie in each other more than {_DEEPEST} deep")
        found = Message(where)
        while True:
            kind, name, line = self._next()
            if name == closing or (kind == "end" and not closing):
                return found
            if kind != "word":
                raise CaffeError(f"line {line}: a field's name was expected, not {name}")
            colon = self._peek()[1] == ":"
            if colon:
                self._next()
            opening = self._peek()[1]
            if opening in _CLOSING and self._peek()[0] == "mark":
                self._next()
                child = self.message(f"{name} at line {line}", _CLOSING[opening], depth + 1)
                found.messages.setdefault(name, []).append(child)
            elif colon:
                found.values.setdefault(name, []).extend(self._values())
            else:
                raise CaffeError(f"line {line}: after {name} a ':' or '{{' was expected")
            if self._peek()[1] in {",", ";"}:
                self._next()

    def _values(self) -> list[str]:
        if self._peek()[1] != "[":
            return [self._value()]
        self._next()
        values: list[str] = []
        while self._peek()[1] != "]":
            values.append(self._value())
            if self._peek()[1] == ",":
                self._next()
        self._next()
        return values

    def _value(self) -> str:
        kind, text, line = self._next()
        if kind == "string":
            return re.sub(r"\\(.)", r"\1", text[1:-1])
        if kind != "word":
            raise CaffeError(f"line {line}: a value was expected, not {text}")
        return text

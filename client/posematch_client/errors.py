"""Everything that can go wrong, as one tree.

::

    ClientError
    ├── RefusedError       the service answered, with an error or with what is no JSON
    └── UnreachableError   there was no answer, it broke off, or the request cannot be sent
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


class ClientError(Exception):
    """Base of the client's errors."""


class RefusedError(ClientError):
    """The service, or a proxy before it, answered with an error, or with what is no JSON.

    ``problem`` is its problem+json (RFC 9457), empty when it sent none; ``slug`` the stable part
    of the problem's type, such as ``"unsupported-image-type"``; ``retry_after_s`` what it asked
    to wait, None when it did not.
    """

    def __init__(
        self, status: int, problem: Mapping[str, Any], retry_after_s: float | None = None
    ) -> None:
        self.status = status
        self.problem = dict(problem)
        self.retry_after_s = retry_after_s
        super().__init__(status, self.problem, retry_after_s)  # so that it can be pickled

    def __str__(self) -> str:
        """Status and detail."""
        return f"{self.status}: {self.detail}"

    @property
    def slug(self) -> str:
        """The last part of the problem's type; empty without a problem."""
        return str(self.problem.get("type", "")).rsplit(":", 1)[-1]

    @property
    def detail(self) -> str:
        """What is wrong, in words."""
        return str(self.problem.get("detail", "the answer says no more"))

    @property
    def request_id(self) -> str | None:
        """What the service's log knows this request by."""
        request_id = self.problem.get("request_id")
        return None if request_id is None else str(request_id)


class UnreachableError(ClientError):
    """No answer came before the deadline, or none can; the cause is httpx's error."""

"""Client of the posematch service: a photo in, everybody's 2D joints and 3D pose out.

``Client`` and ``AsyncClient`` ask; ``Retries`` says for how long they keep trying; answers are the
service's JSON, as the TypedDicts of ``posematch_client.types``.
"""

from posematch_client.asynchronous import AsyncClient
from posematch_client.calls import Photo
from posematch_client.errors import ClientError, RefusedError, UnreachableError
from posematch_client.retries import Retries
from posematch_client.synchronous import Client
from posematch_client.version import VERSION

__version__ = VERSION

__all__ = [
    "AsyncClient",
    "Client",
    "ClientError",
    "Photo",
    "RefusedError",
    "Retries",
    "UnreachableError",
]

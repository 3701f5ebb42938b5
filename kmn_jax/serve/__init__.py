"""A warm process that answers over HTTP, and its client."""

from kmn_jax.serve._client import ServerAnswer, detect_on_server
from kmn_jax.serve._server import serve
from kmn_jax.serve._settings import ServeConfig

__all__ = ["ServeConfig", "ServerAnswer", "detect_on_server", "serve"]

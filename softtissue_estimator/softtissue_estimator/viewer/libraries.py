"""The library of this room, which is an extra (`viewer`): viser, which draws in a browser by WebGL."""

import logging

from softtissue_estimator.errors import MissingDependencyError

try:
    import rich
    import viser as viser
    import websockets.asyncio.server as websocket_server
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response
except ImportError as error:
    raise MissingDependencyError(
        f"viewer: expected viser, got no {error.name}; pip install viser 'rich<15' 'websockets<17',"
        " or softtissue_estimator with [viewer]"
    ) from error

__all__ = ["Headers", "Request", "Response", "viser", "websocket_server"]

# What viser prints is for its own examples; the node says the address.
rich.reconfigure(quiet=True)
# Whoever sends something else than the page does ends their own connection, and fills no log with tracebacks.
logging.getLogger("websockets").addHandler(logging.NullHandler())
logging.getLogger("websockets").propagate = False

"""One thread at a time loads what only some pages need.

A thread that imports a package waits for its modules; one that imports a module first waits for
the package. Python ends such a wait by letting one of them go on with half a module.
"""

import threading
from collections.abc import Awaitable, Callable
from inspect import iscoroutinefunction
from typing import Any

from starlette.concurrency import run_in_threadpool
from starlette.requests import Request
from starlette.responses import Response

LOADING = threading.RLock()
"""Held around each import that a request, or the thread that asks ahead, may be first to make."""


def late(load: Callable[[], Any], name: str) -> Callable[[Request], Awaitable[Response]]:
    """Return a handler that is loaded with its first request.

    Args:
        load: Gives the object that answers, the same one each time; called from several threads.
    """

    async def answer(request: Request) -> Response:
        handler: Callable[[Request], Any] = getattr(await run_in_threadpool(load), name)
        found: Response
        if iscoroutinefunction(handler):
            found = await handler(request)
        else:
            found = await run_in_threadpool(handler, request)
        return found

    return answer

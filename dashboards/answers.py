"""What several addresses answer alike: pictures that may be kept, refusals, JSON that is posted."""

import json
from typing import Any

from starlette.requests import Request
from starlette.responses import JSONResponse, Response


def kept(data: bytes, media_type: str) -> Response:
    """Return what the browser may keep for ten minutes, for its address says which it is."""
    headers = {"Cache-Control": "private, max-age=600"}
    return Response(data, media_type=media_type, headers=headers)


def refused(status: int, message: str) -> Response:
    """Return a refusal that a script of the page shows."""
    return JSONResponse({"message": message}, status_code=status)


async def posted(request: Request, what: str, most_bytes: int) -> dict[str, Any] | Response:
    """Read a JSON object that a page posts, or return the refusal."""
    body = bytearray()
    async for part in request.stream():
        body += part
        if len(body) > most_bytes:
            return refused(413, f"{what} has at most {most_bytes // 1000} kB.")
    if request.headers.get("content-type", "").partition(";")[0] != "application/json":
        return refused(415, f"{what} is sent as application/json.")
    try:
        record = json.loads(body)
    except (ValueError, RecursionError):
        record = None
    return record if isinstance(record, dict) else refused(400, f"{what} is a JSON object.")

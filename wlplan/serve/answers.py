"""What goes back to whoever asked: JSON, and refusals of one line."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from starlette.responses import JSONResponse, Response

from wlplan.errors import InputError


class Refused(InputError):  # noqa: N818
    """A request that is refused with a status of its own; other `InputError`s are a 400.

    Args:
        status: Of HTTP.
        message: One line that says why and what to do.
    """

    def __init__(self, status: int, message: str):
        super().__init__(message)
        self.status = status


def refusal(error: InputError) -> Response:
    """An error as it is answered: `{"error": "one line"}`."""
    status = error.status if isinstance(error, Refused) else 400
    return JSONResponse({"error": " ".join(str(error).split())}, status)


def document_text(document: Mapping[str, Any]) -> str:
    """A document as JSON.

    Raises:
        InputError: If a number is not finite, which JSON cannot express.
    """
    try:
        return json.dumps(document, indent=2, allow_nan=False) + "\n"
    except ValueError as error:
        raise InputError(
            "the result holds numbers that are not finite: check the pile for spikes, or use "
            "another world."
        ) from error


def json_answer(text: str, *, status: int = 200, at: str | None = None) -> Response:
    """A text of JSON.

    Args:
        text: The JSON.
        status: Of HTTP.
        at: Path under which it can be had again, for a while.
    """
    headers = {} if at is None else {"Content-Location": at}
    return Response(text, status, headers, media_type="application/json")

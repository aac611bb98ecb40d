"""Arguments: what does not fit is refused with a ValueError that names the argument, what was expected and what was found."""

from collections.abc import Sequence
from typing import Any, NoReturn

import numpy as np
import pyarrow as pa
import realo_log
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]


def refuse(where: str, name: str, expected: str, found: object, advice: str) -> NoReturn:
    realo_log.refuse(where, name, expected, found, advice)
    raise AssertionError("a refusal raises")


def rows(where: str, name: str, values: ArrayLike, width: int, n: int | None = None) -> Floats:
    """`[n, width]` finite numbers."""
    array: Floats = realo_log.finite(where, name, realo_log.rows_of(where, name, values, width, n)).astype(np.float64)
    return array


def column(where: str, name: str, values: ArrayLike, n: int) -> Floats:
    """One finite number for each of `n` rows, or one for all."""
    array = realo_log.finite(where, name, realo_log.column_of(where, name, values, n))
    return np.array(array, np.float64)


def optional_rows(where: str, name: str, values: ArrayLike | None, width: int, n: int) -> Floats:
    """`[n, width]` numbers; a row of NaN where they are not known."""
    if values is None:
        return np.full((n, width), np.nan)
    given = np.asarray(values)
    # A covariance may be a matrix for each row.
    square = given.ndim == 3 and given.shape[1] * given.shape[2] == width
    array: Floats = realo_log.rows_of(where, name, given.reshape(-1, width) if square else values, width, n).astype(np.float64)
    there = ~np.isnan(array).all(axis=1)
    realo_log.finite(where, name, array[there])
    return array


def whole(where: str, name: str, values: ArrayLike, n: int, low: int, high: int) -> NDArray[np.int64]:
    """One whole number for each of `n` rows, or one for all."""
    array = realo_log.whole(where, name, realo_log.column_of(where, name, values, n), low, high)
    return np.array(array, np.int64)


def texts(where: str, name: str, values: object, n: int) -> NDArray[np.object_]:
    """One text for each of `n` rows, or one for all."""
    if isinstance(values, str):
        return np.full(n, values, object)
    places: Any = slice(None)
    if isinstance(values, np.ndarray) and values.ndim == 1 and values.dtype.kind == "U":
        # Many texts are few names.
        encoded = pa.array(values).dictionary_encode()
        values, places = encoded.dictionary.to_pylist(), encoded.indices.to_numpy()
    given: Sequence[Any] = realo_log.listed(where, name, values, f"a text, or a list of {n} texts, one a box")
    wrong = [text for text in given if not isinstance(text, str) or not text.strip()]
    if wrong:
        refuse(where, name, "texts", f"{wrong[0]!r}", "turn class numbers into names")
    names = np.empty(len(given), object)
    # Plain texts, not those of numpy.
    names[:] = [str(text) for text in given]
    out: NDArray[np.object_] = names[places]
    if len(out) != n:
        refuse(where, name, f"{n} texts, one a box", f"{len(out)}", "give each box one")
    return out


def tracks(where: str, values: object, n: int) -> NDArray[np.object_]:
    """A whole number from 0 for each row, or None."""
    out = np.full(n, None, object)
    if values is None:
        return out
    given = realo_log.listed(where, "track", values, f"a list of {n} tracks, one a box")
    if len(given) != n:
        refuse(where, "track", f"{n} tracks, one a box", f"{len(given)}", "give each box one, None where it has none")
    for at, track in enumerate(given):
        if track is None or (isinstance(track, (float, np.floating)) and np.isnan(track)):
            continue
        is_number = isinstance(track, (int, float, np.integer, np.floating)) and not isinstance(track, bool)
        if not is_number or track != int(track) or not 0 <= int(track) < 2**64:
            refuse(where, "track", "whole numbers from 0, or None", f"{track!r}", "number the tracks")
        out[at] = int(track)
    return out


def one_of(where: str, name: str, value: str, known: Sequence[str]) -> str:
    if value not in known:
        refuse(where, name, f"one of {', '.join(known)}", f"{value!r}", "take one of them")
    return value

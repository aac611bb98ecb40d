"""Tables of Arrow, and pandas where it is installed."""

from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

if TYPE_CHECKING:
    import pandas as pd


def to_dataframe(table: pa.Table) -> "pd.DataFrame":
    """A table as a DataFrame of pandas, which is imported here."""
    try:
        import pandas  # noqa: F401
    except ImportError as error:
        raise ImportError(
            "a DataFrame needs pandas: `python -m pip install pandas`, or take `to_arrow()`, which polars reads by `polars.from_arrow`"
        ) from error
    return table.to_pandas()


def to_table(values: Any, where: str) -> pa.Table:
    """A table of what holds columns: of Arrow, of pandas, of polars."""
    if isinstance(values, (pa.Table, pa.RecordBatch)):
        return pa.table(values)
    if hasattr(values, "__arrow_c_stream__"):
        return pa.table(values)
    if type(values).__module__.split(".")[0] == "pandas":
        return pa.Table.from_pandas(values, preserve_index=False)
    raise ValueError(f"`{where}`: expected a table of pyarrow, or a DataFrame, found {type(values).__name__}")


def fixed(column: pa.ChunkedArray | pa.Array, width: int) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Rows of so many numbers; NaN where a row is null."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    out = np.full((len(array), width), np.nan)
    known = array.is_valid().to_numpy(zero_copy_only=False)
    out[known] = array.flatten().to_numpy(zero_copy_only=False).reshape(-1, width)
    return out


def listed(rows: np.ndarray[Any, np.dtype[np.float64]]) -> pa.Array:
    """The opposite of `fixed`: a row of NaN is null."""
    unknown = pa.array(np.isnan(rows).all(axis=1))
    values = pa.array(np.ascontiguousarray(rows).ravel(), pa.float64())
    return pa.FixedSizeListArray.from_arrays(values, rows.shape[1], mask=unknown)

"""A table as a structured numpy array whose fields have their units in their names."""

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pandas as pd


class Table(np.ndarray[tuple[int], np.dtype[np.void]]):
    """One row for each thing and one field for each of its values, shape (k,).

    The name of a field ends in its unit: ``t_s``, ``x_m``, ``move_um``. ``table["x_m"]`` is a plain array. Unknown
    numbers are NaN, unknown texts are empty. ``descriptions`` has a sentence for a field that needs one.
    """

    descriptions: Mapping[str, str]

    def __new__(cls, fields: Mapping[str, npt.ArrayLike], descriptions: Mapping[str, str] | None = None) -> "Table":
        """A table of equally long columns."""
        columns = {name: np.asarray(column) for name, column in fields.items()}
        lengths = {len(column) for column in columns.values()}
        if len(lengths) != 1:
            raise ValueError(f"columns of a table have one length, not {sorted(lengths)}")
        table = np.empty(lengths.pop(), dtype=[(name, column.dtype) for name, column in columns.items()]).view(cls)
        for name, column in columns.items():
            table[name] = column
        table.descriptions = dict(descriptions or {})
        return table

    def __array_finalize__(self, source: Any) -> None:
        """A part of a table keeps its descriptions."""
        self.descriptions = getattr(source, "descriptions", {})

    def __getitem__(self, key: Any) -> Any:
        """Rows are a table or a record, one field is a plain array."""
        found = super().__getitem__(key)
        return found.view(np.ndarray) if isinstance(found, Table) and found.dtype.names is None else found

    def to_pandas(self) -> "pd.DataFrame":
        """The table as a DataFrame; ImportError: pandas is not installed."""
        try:
            import pandas as pd  # noqa: PLC0415 - not a dependency
        except ImportError as error:
            raise ImportError("pandas is not installed: pip install pandas, or use the table as an array") from error
        return pd.DataFrame({name: self[name] for name in self.dtype.names or ()})


# Fields with whole numbers, which are always known, and fields with texts. All others are of floats.
_WHOLE = frozenset((
    "session", "frame", "row", "col", "point", "points", "number", "lap", "waypoint", "sensor", "pulse",
    "drive_seq", "front_left", "front_right", "rear_left", "rear_right",
))  # fmt: skip
_TEXTS = frozenset((
    "status", "metrology", "channels", "left_out", "outliers", "adjuster", "name", "severity", "cause", "advice",
    "raised_utc", "ended_utc", "acknowledged_utc", "acknowledged_by", "faults",
))  # fmt: skip


def table_of_rows(
    names: Sequence[str],
    rows: Iterable[Sequence[object]],
    descriptions: Mapping[str, str] | None = None,
    texts: Collection[str] = (),
) -> Table:
    """A table of rows, values in the order of ``names``; ``None`` is an unknown value.

    Its fields have the same types whatever the rows are. ``texts``: fields of texts beside those of every mission.
    """
    found = list(rows)
    columns = zip(*found, strict=True) if found else ((),) * len(names)
    return Table(
        {name: _column(name, column, texts) for name, column in zip(names, columns, strict=True)}, descriptions
    )


def table_of_records(columns: Mapping[str, str], records: Iterable[Mapping[str, object]]) -> Table:
    """A table of rows by name; ``columns``: names and descriptions. A value that is missing is not known."""
    return table_of_rows(tuple(columns), ([record.get(name) for name in columns] for record in records), columns)


def _column(name: str, values: Sequence[Any], texts: Collection[str]) -> npt.NDArray[Any]:
    if name in _TEXTS or name in texts:
        return np.array(["" if value is None else str(value) for value in values], dtype=np.str_)
    if name in _WHOLE:
        return np.array(values, dtype=np.int64)
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)

"""One Rerun recording being written to a file: its only timeline is the cell's source time."""

from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Float, Int

from bridge.errors import UsageError
from bridge.geometry.trajectory import PoseTrajectory
from dashboards.errors import DashboardError

APPLICATION = "robot-gst"
TIMELINE = "source_time"
FLUSH_S = 60.0


class RerunFile:
    """Rows go in by column, nothing is logged at wall-clock time; ``notes`` says what is not in it.

    Written as ``FILE.part`` and renamed when complete.
    """

    def __init__(self, path: Path, *, recording_id: str, name: str) -> None:
        """Open ``<path>.part``, replacing what an interrupted export left."""
        if path.is_dir():
            message = f"{path} is a folder. Name a file: --out {path / 'episode.rrd'}."
            raise UsageError(message)
        self.path = path
        self.notes: list[str] = []
        self._part = path.with_name(path.name + ".part")
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            self._part.write_bytes(b"")  # fail now, not after the export, if it cannot be written
        except OSError as error:
            message = f"cannot write {self._part}: {error.strerror}. Choose another with --out."
            raise DashboardError(message) from error
        self.stream = rr.RecordingStream(APPLICATION, recording_id=recording_id)
        try:
            self.stream.save(self._part)
        except RuntimeError as error:  # what Rerun makes of everything that goes wrong
            raise self._unwritten(error) from error
        self.stream.send_recording_name(name)

    def _unwritten(self, error: RuntimeError) -> DashboardError:
        """Remove the partial file and return the error to raise."""
        self._part.unlink(missing_ok=True)
        return DashboardError(
            f"cannot write {self._part}: {error}. Is the disk full? Make space, or choose another "
            "file with --out."
        )

    def note(self, text: str) -> None:
        """Add a note about something that is not shown, once."""
        if text not in self.notes:
            self.notes.append(text)

    def rows(
        self,
        entity: str,
        stamps_ns: Int[np.ndarray, " num_rows"],
        columns: Iterable[Any],
    ) -> None:
        """Send component columns, one row per stamp of source time [ns].

        Args:
            entity: Path of the entity.
            stamps_ns: Source time of each row.
            columns: Component columns of as many rows, as Rerun's ``columns`` methods make them.
        """
        times = np.asarray(stamps_ns, dtype=np.int64).astype("datetime64[ns]")
        index = rr.TimeColumn(TIMELINE, timestamp=times)
        self.stream.send_columns(entity, [index], columns, strict=True)

    def always(self, entity: str, *archetypes: Any) -> None:
        """Log something that holds at all times."""
        for archetype in archetypes:
            self.stream.log(entity, archetype, static=True, strict=True)

    def scalars(
        self,
        entity: str,
        stamps_ns: Int[np.ndarray, " num_rows"],
        values: Float[np.ndarray, " num_rows"],
        *,
        name: str,
        color: tuple[int, int, int],
        width: float,
    ) -> None:
        """Send one number over time, with its name in the legend.

        Args:
            entity: Path of the series.
            stamps_ns: Source time of each value.
            values: The number at each stamp.
            name: What the legend says.
            color: Of the line: red, green, blue, each 0 to 255.
            width: Of the line, in points.
        """
        self.always(entity, rr.SeriesLines(names=[name], colors=[color], widths=[width]))
        values = np.asarray(values, dtype=np.float64)
        self.rows(entity, stamps_ns, rr.Scalars.columns(scalars=values))

    def poses(self, entity: str, track: PoseTrajectory) -> None:
        """Send ``T_base_entity`` over time.

        Args:
            entity: Path of the entity.
            track: ``T_base_entity`` over source time.
        """
        columns = rr.Transform3D.columns(
            translation=track.p_m, quaternion=np.roll(track.q_wxyz, -1, axis=1)
        )
        self.rows(entity, track.stamps_ns, columns)

    def place(self, entity: str, T_base_entity: Float[np.ndarray, "4 4"]) -> None:
        """Log where an entity stands at all times; nothing where that is the base itself."""
        if not np.array_equal(T_base_entity, np.eye(4)):
            placed = rr.Transform3D(translation=T_base_entity[:3, 3], mat3x3=T_base_entity[:3, :3])
            self.always(entity, placed)

    def __enter__(self) -> "RerunFile":
        """Write inside the block."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Finish the file and give it its name; after an error remove what there is.

        Raises:
            DashboardError: When not everything could be written, as on a full disk.
        """
        unwritten: RuntimeError | None = None
        try:
            self.stream.flush(timeout_sec=FLUSH_S)
        except RuntimeError as failed:
            unwritten = failed
        self.stream.disconnect()
        if kind is None and unwritten is None:
            self._part.replace(self.path)
            return
        self._part.unlink(missing_ok=True)
        if kind is None and unwritten is not None:
            raise self._unwritten(unwritten) from unwritten

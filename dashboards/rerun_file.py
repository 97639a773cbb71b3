"""One Rerun recording being written to a file: its only timeline is the cell's source time."""

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from jaxtyping import Int

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
        self.stream.set_log_time_enabled(False)
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
        self, entity: str, stamps_ns: Int[np.ndarray, " num_rows"], columns: Iterable[Any]
    ) -> None:
        """Send component columns, one row per stamp of source time [ns]."""
        times = np.asarray(stamps_ns, dtype=np.int64).astype("datetime64[ns]")
        index = rr.TimeColumn(TIMELINE, timestamp=times)
        self.stream.send_columns(entity, [index], columns, strict=True)

    def at(self, entity: str, stamp_ns: int, archetype: Any) -> None:
        """Log something that holds from an instant of source time on [ns]."""
        self.stream.set_time(TIMELINE, timestamp=np.datetime64(stamp_ns, "ns"))
        self.stream.log(entity, archetype, strict=True)

    def always(self, entity: str, archetype: Any) -> None:
        """Log something that holds at all times."""
        self.stream.log(entity, archetype, static=True, strict=True)

    def poses(self, entity: str, track: PoseTrajectory, shift_ns: int = 0) -> None:
        """Send ``T_base_entity`` over time; ``shift_ns`` brings its stamps to source time."""
        columns = rr.Transform3D.columns(
            translation=track.p_m, quaternion=np.roll(track.q_wxyz, -1, axis=1)
        )
        self.rows(entity, track.stamps_ns + shift_ns, columns)

    def __enter__(self) -> "RerunFile":
        """Write inside the block."""
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
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

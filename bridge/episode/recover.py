"""Make a readable episode of what a killed writer left, whoever the writer was.

A part is recovered into a copy beside it (``<name>.recovering``). When the copy is on the disk and
proved, it takes the part's name, then the final one: whenever this is killed, either the old part
or a finished one is there, and it can be run again.

Everything whole is carried over: chunks byte for byte, behind the definitions of all of them.
Messages outside chunks are put into chunks, because readers that use the index see nothing else.
Message indexes, summary and footer are made anew.
"""

import os
import shutil
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from io import BufferedReader
from pathlib import Path

from mcap.records import Attachment, Header, Metadata

from bridge.episode.check_file import Faults, checked_messages
from bridge.episode.mcap import format as mcap
from bridge.episode.mcap.damaged import RecordFile, finished_data
from bridge.episode.mcap.data_section import DataSection, EncodedChunk, OpenChunk
from bridge.episode.mcap.part_file import PartFile, lock_dead, sync_folder
from bridge.episode.mcap.scan import Chunk, Found, Plain, TopMessage, scan
from bridge.episode.mcap.walk import chunk_entry
from bridge.episode.metadata import KINDS, Derived, EpisodeInfo, Outcome, build, from_strings
from bridge.episode.recovery_report import RECORD_NAME, RecoveryReport, RecoveryTally, to_metadata
from bridge.episode.run_folder import PART, SUFFIX, RunFolder
from bridge.errors import BridgeError, GstError, PathNotFoundError

TEMPORARY, UNREADABLE = ".recovering", ".unreadable"
SPARE_BYTES = 16 << 20


class RecoveryError(BridgeError):
    """A file cannot be recovered now."""


class StillWrittenError(RecoveryError):
    """The writer of a part is alive."""


def recover(path: Path) -> RecoveryReport:
    """Recover one file.

    ``<id>.mcap.part`` becomes ``<id>.mcap``, or ``<id>_recovered.mcap`` where that name is taken.
    Another broken file stays as it is, and ``<name>_recovered.mcap`` is made of it. A finished
    file is only renamed, if that.
    """
    if not path.is_file():
        hint = "robot-gst recover takes files, or folders to search for *.mcap.part."
        raise PathNotFoundError(path=path, what="file", hint=hint)
    is_part = path.name.endswith(PART)
    with _locked(path, write=is_part) as stream:
        source = RecordFile(stream)
        finished = _report_finished(path, source)
        if finished is not None:
            return finished
        if shutil.disk_usage(path.parent).free < source.size + SPARE_BYTES:
            size = f"{path} needs {source.size / 1e6:.0f} MB beside it for a copy."
            raise RecoveryError(f"{size} Free some space, or move it to another disk.")
        return _recover_copy(path, source)


def recover_parts(run: RunFolder) -> list[RecoveryReport]:
    """Recover every part a dead writer left in ``episodes/``; parts being written are left alone.

    What cannot be read at all is renamed to ``*.unreadable``, so that its name is free again. A
    part that fails for another reason stays, and its report says why.
    """
    reports = []
    for path in sorted(run.episodes_dir.glob(f"*{SUFFIX}{PART}")):
        try:
            report = recover(path)
        except StillWrittenError:
            continue
        except (GstError, OSError) as error:
            report = RecoveryReport(path=path, output=None, reason=str(error))
        else:
            if report.output is None:
                _set_aside(path)
        reports.append(report)
    return reports


def _set_aside(path: Path) -> None:
    """Give an unreadable part a name that stands in nobody's way."""
    base = path.name.removesuffix(PART)
    target, number = path.with_name(base + UNREADABLE), 2
    while target.exists():
        target, number = path.with_name(f"{base}{UNREADABLE}{number}"), number + 1
    path.rename(target)


@contextmanager
def _locked(path: Path, *, write: bool) -> Iterator[BufferedReader]:
    descriptor = lock_dead(path, write=write)
    if descriptor is None:
        raise StillWrittenError(f"{path} is still being written. Stop its recorder first.")
    with os.fdopen(descriptor, "rb") as stream:
        yield stream


def _report_finished(path: Path, source: RecordFile) -> RecoveryReport | None:
    """Rename a file that is whole; None when it is not."""
    data = finished_data(source)
    if data is None:
        return None
    faults, (end, is_proved) = Faults(), data
    if not is_proved:  # then its indexes may be wrong all the same
        deque(checked_messages(path, faults), maxlen=0)
    if faults.count:
        return None
    tally = RecoveryTally()
    for found in scan(source):
        tally.take(found)
    if tally.losses or tally.reached_end != end:
        return None
    return tally.report(path, _publish(path) if path.name.endswith(PART) else path, finished=True)


def _recover_copy(path: Path, source: RecordFile) -> RecoveryReport:
    temporary = path.with_name(path.name.removesuffix(PART) + TEMPORARY)
    temporary.unlink(missing_ok=True)  # of a recovery that was killed; the lock is ours
    tally = RecoveryTally()
    for found in each_chunk_once(source):
        tally.take(found)
    if not tally.has_data:
        return tally.report(path, None, finished=False)
    tally.complete(source)
    report = tally.report(path, None, finished=False)
    target: CopyTarget | None = None
    try:
        target = CopyTarget(source, temporary, tally)
        for found in each_chunk_once(source):
            target.take(found)
        target.finish(RECORD_NAME, to_metadata(report))
        _prove(temporary)
        original = _keep_original(path) if tally.damaged_inside else None
        return replace(report, output=_replace(path, temporary), original=original)
    except OSError as error:
        message = f"{path} could not be copied: {error.strerror}. Free some space, then try again."
        raise RecoveryError(message) from error
    finally:
        if target is not None:
            target.section.file.close()
        temporary.unlink(missing_ok=True)


def _prove(path: Path) -> None:
    """Read the copy back; its CRC covers every byte that was found whole before."""
    with path.open("rb") as stream:
        if finished_data(RecordFile(stream)) is None:
            raise RecoveryError(f"{path} does not hold what was written to it. Check the disk.")


def _keep_original(path: Path) -> Path | None:
    if not path.name.endswith(PART):
        return path
    kept = path.with_name(path.name.removesuffix(PART) + ".damaged")
    try:
        if not kept.exists():
            kept.hardlink_to(path)
    except OSError:  # some disks have no hard links; the damage is in the report all the same
        return None
    return kept


def _replace(path: Path, temporary: Path) -> Path:
    if path.name.endswith(PART):
        temporary.rename(path)
        sync_folder(path.parent)
        return _publish(path)
    output = _free_name(path, taken=True)
    temporary.rename(output)
    sync_folder(output.parent)
    return output


def _publish(part_path: Path) -> Path:
    output = _free_name(part_path.with_name(part_path.name.removesuffix(PART)), taken=False)
    part_path.rename(output)
    sync_folder(output.parent)
    return output


def _free_name(path: Path, *, taken: bool) -> Path:
    """Return the path, or where it is ``taken`` one with ``_recovered`` behind the id."""
    base, dot, rest = path.name.partition(".")
    number = 1
    output = path
    while taken or output.exists():
        suffix = "_recovered" if number == 1 else f"_recovered_{number}"
        output = path.with_name(f"{base}{suffix}{dot}{rest}")
        taken, number = False, number + 1
    return output


CHUNK_BYTES = 1 << 20
UNKNOWN_LIBRARY = "unknown; recovered by robot-gst"
"""Of a file whose header was lost: its messages are held to no promise of ours."""


def each_chunk_once(source: RecordFile) -> Iterator[Found]:
    """Return what a file holds; a chunk that lies there twice is given once."""
    there: set[tuple[int, int]] = set()
    for found in scan(source):
        if isinstance(found, Chunk) and found.packed.uncompressed_crc:
            key = found.packed.uncompressed_crc, found.packed.uncompressed_size
            if key in there:
                continue
            there.add(key)
        yield found


_RECORDS: dict[str, type] = {"episode": EpisodeInfo, "outcome": Outcome, "derived": Derived}
DAMAGED = ".damaged"
"""Behind the name of a metadata record of ours that cannot be read; no CRC covers those."""


def is_readable(name: str, values: dict[str, str]) -> bool:
    """Whether a metadata record, if it is one of ours, holds what it should."""
    if name not in _RECORDS:
        return True
    try:
        built: object = build(_RECORDS[name], from_strings(values))
    except ValueError:
        return False
    return not isinstance(built, EpisodeInfo) or built.kind in KINDS


class CopyTarget:
    """The new file."""

    def __init__(self, source: RecordFile, path: Path, tally: RecoveryTally) -> None:
        """Create ``path``, with all definitions; OSError when it exists or cannot be written."""
        self._source = source
        self.section = DataSection(PartFile.create(path))
        self._loose = OpenChunk(compress=False, is_small=True)
        self.section.summary.schemas, self.section.summary.channels = tally.schemas, tally.channels
        header = tally.header or Header("", UNKNOWN_LIBRARY)
        front = [header, *tally.schemas.values(), *tally.channels.values()]
        self.section.file.append([mcap.MAGIC, *map(mcap.encoded, front)])

    def take(self, found: Found) -> None:
        """Copy one thing; definitions, index spans, damage and the old end are left behind."""
        match found:
            case Plain(record=Attachment() as attachment):
                self.section.add_attachment(attachment)
            case Plain(record=Metadata(name=name, metadata=values)):
                kept_as = name if is_readable(name, values) else name + DAMAGED
                self.section.add_metadata(kept_as, values)
            case Plain(record=None):
                self.section.file.append([found.raw])
            case Chunk():
                self.section.add_chunks([verbatim(found)])
            case TopMessage():
                self._take_message(found)

    def finish(self, metadata_name: str, values: dict[str, str]) -> None:
        """Write the rest and sync; the caller verifies, renames and closes."""
        self._flush_loose()
        self.section.add_metadata(metadata_name, values)
        self.section.seal()
        self.section.file.sync_data()

    def _take_message(self, found: TopMessage) -> None:
        if self._loose.size + found.length > CHUNK_BYTES:
            self._flush_loose()
        raw = self._source.read(found.offset, found.length)
        _, _, channel_id, sequence, log_ns, publish_ns = mcap.MESSAGE_HEAD.unpack_from(raw)
        data = memoryview(raw)[mcap.MESSAGE_HEAD.size :]
        self._loose.add(channel_id, sequence, log_ns, publish_ns, data, len(data))

    def _flush_loose(self) -> None:
        if self._loose.has_messages:
            self.section.add_chunks([self._loose.encode()])


_TIMES = struct.Struct("<QQ")


def verbatim(found: Chunk) -> EncodedChunk:
    """Return a chunk as it stands in the file, with the times of its messages in its head.

    No CRC covers what stands there.
    """
    times_ns, at = found.contents.time_range(), mcap.RECORD_HEAD.size
    front = found.raw[:at] + _TIMES.pack(*times_ns)
    entry = chunk_entry(0, found.length, found.packed)
    entry.message_start_time, entry.message_end_time = times_ns
    return EncodedChunk([front, memoryview(found.raw)[len(front) :]], entry, found.contents.index)

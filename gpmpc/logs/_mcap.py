"""Reads MCAP files: recordings of this package as one table, bags as one per topic."""

from pathlib import Path

from gpmpc.exceptions import DataError
from gpmpc.logs._bag import has_own_profile, read_bag
from gpmpc.logs._file import LogFile, ReadOptions, flaw_findings


def read_mcap(path: Path, options: ReadOptions) -> LogFile:
    """Reads a file as what its head and its definitions say that it is."""
    if has_own_profile(path):
        return _read_recording(path, options)
    bag = read_bag(path, options)
    if bag is None:
        return _read_recording(path, options)
    return bag


def _read_recording(path: Path, options: ReadOptions) -> LogFile:
    from gpmpc.recording import read_run

    run = read_run(path)
    if not run.whole and not options.partial:
        reasons = "; ".join(flaw.text for flaw in run.flaws)
        raise DataError(
            f"{path}: unfinished or damaged; gpmpc log recover rescues it, "
            f"partial=true takes what is whole ({reasons})"
        )
    return LogFile({"": run.to_pandas()}, tuple(flaw_findings(path, run.flaws)))

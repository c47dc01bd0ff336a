"""A first description of a table."""

from pathlib import Path

from imu_fusion.errors import BagError
from imu_fusion.recordings.source_storage import format_of
from imu_fusion.recordings.targets import refuse_files, whole_file
from imu_fusion.sources.sketch import sketch
from imu_fusion.sources.transports.files import parts

_HEAD = 1 << 20    # bytes that are looked at


def describe(source: str | Path, out: str | Path | None = None, overwrite: bool = False
             ) -> tuple[str, str]:
    """Describe a table from its header and values.

    Args:
        source: file. out: YAML file to write, None for none. overwrite: replace it.

    Returns:
        (text of the description, empty where none is needed, and what to do with it)

    Raises:
        ImuFusionError: the source is no table of numbers, or ``out`` cannot be written.
    """
    source = Path(source)
    if not source.exists():
        raise BagError(f"{source}: no such file or directory")
    known = format_of(source)
    if known is not None and known.name != "table":
        return "", f"{source}: {known.about}; convert takes it without a description"
    if source.is_dir():
        raise BagError(f"{source}: a folder; describe one of its files")
    name, data = next(parts(source, _HEAD), (str(source), b""))
    text = sketch(data, name).to_yaml()
    if out is None:
        return text, "write it to a file with --out, and check the guesses"
    out = Path(out)
    refuse_files([source], out)
    if out.exists() and not overwrite:
        raise BagError(f"{out}: exists already; choose another name or --overwrite")
    with whole_file(out) as file:
        file.write_text(text)
    return text, (f"written: {out}; check the guesses, then imu_fusion convert {source} OUT "
                  f"--description {out}")

"""`kornia-tidy raw info`: properties of camera raw files."""

from __future__ import annotations

from dataclasses import dataclass, field

from kornia_tidy.cli.commands.raw_options import Dump, RawFiles


@dataclass(frozen=True, kw_only=True)
class InfoOfRaw:
    """Properties of raw files.

    Printed are camera, lens and exposure; size and filter array of the visible area; black
    and white levels and the range of the counts; white balance as shot, colour matrices and
    orientation; opcodes of a DNG that are not applied. Every file is decoded completely, so
    a file that is listed can be developed. Exit status 2 if any file failed.

    Args:
        files: camera raw files.
        dump: layout of a headerless file.

    Examples:
        All files of a folder, those that fail are named at the end:
          kornia-tidy raw info shots/*.dng

        A bare dump of counts, 16 bits each:
          kornia-tidy raw info dump.raw --size 768x512 --pattern RGGB --black 600 --white 15520
    """

    files: RawFiles
    dump: Dump = field(default_factory=Dump)

    def run(self) -> None:
        """Print the properties of raw files."""
        from kornia_tidy.cli.commands.report import tell
        from kornia_tidy.lab.file_jobs import for_each_file
        from kornia_tidy.lab.raw.properties import raw_in_words

        def look(path: str) -> None:
            topics = raw_in_words(self.dump.open(path))
            for topic, text in [("file", path), *topics]:
                tell(topic, text)
            print(flush=True)

        for_each_file(self.files, look)

"""What somebody names on the command line -> the recordings that are there."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.errors import RecordingImportError, UsageError
from dmotion_bench.storage.imports.bags import bags_of, told_of_bags
from dmotion_bench.storage.imports.lerobot_layout import INFO
from dmotion_bench.storage.imports.natural_order import in_natural_order
from dmotion_bench.storage.imports.passed_over import (
    NOT_READ,
    PassedOver,
    Taken,
    arrays_in,
    is_dataset,
    passed_over,
    real_paths,
)
from dmotion_bench.storage.imports.picture_folder import (
    PICTURES,
    episode_folders,
    folder_and_pattern,
    listed_patterns,
    pattern_of,
    patterns_in,
)
from dmotion_bench.storage.imports.picture_numbers import NUMBER
from dmotion_bench.storage.imports.sources import CONVERT_BAG, KNOWN, SUFFIXES, Kind, Source, camera_file, kind_of
from dmotion_bench.wording import command, shown

_SHOWN: Final = 5  # names in a sentence


@dataclass(frozen=True, kw_only=True)
class Found:
    """What somebody has named, before any of it is opened.

    Attributes:
        sources: The recordings, in their order.
        faults: Why a path, or a folder in one, gives no recording.
        told: Sentences about what lies in the folders and is not imported.
        doubts: Of a folder whose pictures may not be those that are meant: why, for the case that they are too few.
        bags: The folders of the bags that several of the recordings are parts of, by these recordings' paths.
    """

    sources: Sequence[Source]
    faults: Mapping[Path, RecordingImportError]
    told: Sequence[str]
    doubts: Mapping[Path, str]
    bags: Mapping[Path, Path]

    def require_sound(self) -> None:
        """Check that everything can be imported.

        Raises:
            RecordingImportError: The first fault.
        """
        for fault in self.faults.values():
            raise fault


def find(paths: Sequence[Path], camera: str | None, *, salvage: bool = False, skip_damaged: bool = False) -> Found:
    """The recordings that are meant: files as they are, folders by what is in them.

    Args:
        paths: Files and folders.
        camera: The camera that was asked for; of pictures it is a folder, of videos it may be the name of files.
        salvage: Whether empty files are told of and no faults, if there are recordings besides them.
        skip_damaged: Whether recordings with a fault are left out.

    Raises:
        UsageError: A recording is named twice.
    """
    sources: list[Source] = []
    faults: dict[Path, RecordingImportError] = {}
    for path in paths:
        try:
            sources += _at(path, camera, faults)
        except RecordingImportError as error:
            faults[path] = error
        except OSError as error:
            faults[path] = _unreadable(path, error)
    empty = dict.fromkeys(one.path for one in sources if _is_empty(one.path))
    sources = [one for one in sources if one.path not in empty]
    is_harmless = salvage and bool(sources)
    if not is_harmless:
        faults |= {path: _empty(path, sources, skip_damaged) for path in empty}
    folders = {one.path: episode_folders(one.path, camera) for one in sources if one.kind is Kind.PICTURES}
    require_once(sources, folders)
    taken = _taken(sources, folders, camera, [*faults, *empty])
    over = [_passed_over(path, taken) for path in paths if _is_told_of(path, faults)]
    bags = bags_of(source.path for source in sources if source.kind is Kind.MCAP)
    return Found(
        sources=sources,
        faults=faults,
        told=[
            *(sentence for one in over for sentence in one.sentences(camera)),
            *(told for path in paths if (told := _likely_cameras(path, sources) or _likely_views(path, sources))),
            *told_of_bags(bags),
            *([_told_of_empty(list(empty))] if empty and is_harmless else []),
        ],
        doubts={one.folder: _doubt(one) for one in over if one.readable and one.folder in folders},
        bags=bags,
    )


def sources_in(paths: Sequence[Path], camera: str | None) -> Sequence[Source]:
    """The recordings that are meant, all of which must be there; see ``find``.

    Raises:
        RecordingImportError: A path is not there, or holds no recording.
        UsageError: A recording is named twice.
    """
    found = find(paths, camera)
    found.require_sound()
    return found.sources


def require_once(found: Sequence[Source], folders: Mapping[Path, Sequence[Path]]) -> None:
    """Check that no recording is meant twice, nor a folder of pictures that is an episode of one.

    Args:
        found: The recordings.
        folders: Of those that are pictures: the folders that are an episode each.

    Raises:
        UsageError: One is.
    """
    first: dict[Path, Path] = {}
    for path in (path for source in found for path in dict.fromkeys([source.path, *folders.get(source.path, ())])):
        real = path.resolve()
        if first.get(real) == path:
            raise UsageError(f"{str(path)!r} is named twice; name it once.")
        if real in first:
            raise UsageError(f"{str(first[real])!r} and {str(path)!r} are the same recording; leave one out.")
        first[real] = path


def _is_told_of(path: Path, faults: Mapping[Path, RecordingImportError]) -> bool:
    return path not in faults and path.is_dir() and not (path / INFO).is_file()


def _passed_over(folder: Path, taken: Taken) -> PassedOver:
    return passed_over(folder, taken, (*SUFFIXES, *PICTURES), INFO)


def _taken(
    sources: Sequence[Source], inside: Mapping[Path, Sequence[Path]], camera: str | None, faults: Iterable[Path]
) -> Taken:
    """What the recordings consist of, and what is told as a fault."""
    folders = [folder for each in inside.values() for folder in each]
    return Taken(
        whole=real_paths([*faults, *(source.path for source in sources if source.kind is not Kind.PICTURES)]),
        pictures=real_paths(folders),
        chosen=real_paths(
            [one.parent for one in folders if one.name == folder_and_pattern(camera)[0]]
            + [
                source.path.parent
                for source in sources
                if source.kind is Kind.VIDEO and camera_file(source.path, camera)
            ]
        ),
    )


def _likely_cameras(folder: Path, sources: Sequence[Source]) -> str | None:
    """What is told of videos that have the same names in most folders, as those of several cameras have."""
    names: dict[Path, list[str]] = {}
    for source in sources:
        if source.kind is Kind.VIDEO and source.path.parent.parent == folder:
            names.setdefault(source.path.parent, []).append(source.path.name)
    usual, count = Counter(map(tuple, names.values())).most_common(1)[0] if names else ((), 0)
    if len(usual) < 2 or count < 2 or 2 * count <= len(names):
        return None
    first = Path(usual[0])
    option = "" if first.stem.isdecimal() else f"'--camera {first.stem}' or "
    return (
        f"{count} folders in {str(folder)!r} hold videos of the same names: {', '.join(usual[:_SHOWN])}"
        f"{' and more' if len(usual) > _SHOWN else ''}. If they are several cameras, import one of them, such as with "
        f"{option}'{folder}/*/{first.name}': a data set has one camera."
    )


def _likely_views(folder: Path, sources: Sequence[Source]) -> str | None:
    """What is told of videos in one folder whose names have several patterns with the same numbers, as views have."""
    numbers: dict[str, set[tuple[str, ...]]] = {}
    for stem in (one.path.stem for one in sources if one.kind is Kind.VIDEO and one.path.parent == folder):
        numbers.setdefault(pattern_of(stem), set()).add(tuple(NUMBER.findall(stem)))
    for first, given in numbers.items():
        alike = [name for name, other in numbers.items() if len(given & other) >= max(2, (len(given | other) + 1) // 2)]
        if len(alike) > 1:
            return (
                f"the names of the videos in {str(folder)!r} have several patterns with the same numbers ('#' is a "
                f"number): {', '.join(map(shown, alike[:_SHOWN]))}{' and more' if len(alike) > _SHOWN else ''}. If "
                f"they are several cameras, import one of them, such as with --camera {shown(first)}: a data set has "
                "one camera."
            )
    return None


def _doubt(over: PassedOver) -> str:
    """What is said of pictures that are too few, beside others that were passed over."""
    named = command("dmbench data import", over.readable[0])
    return (
        f"the pictures that were found in {str(over.folder)!r} are too few for an episode, and other recordings or "
        f"pictures in it were not looked at: {over.listed(over.readable)}. If the recordings are there, name all of "
        f"them, such as {named} and so on; the shell's '*/' names all folders. If the few pictures are the recording, "
        "lower '--min-frames' or name their folder alone."
    )


def _at(path: Path, camera: str | None, faults: dict[Path, RecordingImportError]) -> list[Source]:
    """The recordings at a path; see ``_in_folder``."""
    if not path.exists():
        raise RecordingImportError(f"there is no {str(path)!r}; name a file or a folder of recordings.")
    if path.is_dir():
        return _in_folder(path, camera, faults)
    return [Source(path=path, kind=(_suffix_kind(path) or Kind.MCAP) if _is_empty(path) else kind_of(path))]


def _in_folder(folder: Path, camera: str | None, faults: dict[Path, RecordingImportError]) -> list[Source]:
    """The recordings in a folder, and in the folders in it.

    Args:
        folder: It.
        camera: See ``find``.
        faults: Is told which folders in it cannot be read.
    """
    if is_dataset(folder):
        raise RecordingImportError(
            f"{str(folder)!r} is a data set of dmbench already; train on it with "
            f"{command('dmbench train MODEL --data', folder)}."
        )
    if (folder / INFO).is_file():
        return [Source(path=folder, kind=Kind.LEROBOT)]
    entries = in_natural_order(_shown_in(folder))
    found = [Source(path=one, kind=kind) for one in entries if one.is_file() and (kind := _suffix_kind(one))]
    for inner in [] if found else [one for one in entries if one.is_dir()]:
        try:
            if (inner / INFO).is_file():
                found.append(Source(path=inner, kind=Kind.LEROBOT))
            elif not is_dataset(inner):
                files = in_natural_order(one for one in _shown_in(inner) if one.is_file())
                found += [Source(path=one, kind=kind) for one in files if (kind := _suffix_kind(one))]
        except OSError as error:
            faults[inner] = _unreadable(inner, error)
    found = _of_camera(found, folder, camera)
    if not found and episode_folders(folder, camera):
        return [Source(path=folder, kind=Kind.PICTURES)]
    if not found and camera is not None and (others := episode_folders(folder, None)):
        raise _no_folder_of(camera, folder, others)
    if not found and not any(folder in one.parents for one in faults):
        raise _nothing_in(folder, camera)
    kinds = {source.kind for source in found}
    if len(kinds) > 1:
        raise RecordingImportError(
            f"{str(folder)!r} holds recordings of several kinds ({', '.join(sorted(kinds))}); name the ones you mean."
        )
    return found


def _shown_in(folder: Path) -> Iterator[Path]:
    """What lies in a folder and is not hidden; macOS leaves a file ``._front.mp4`` beside each that it copies."""
    return (one for one in folder.iterdir() if not one.name.startswith("."))


def _of_camera(found: list[Source], folder: Path, camera: str | None) -> list[Source]:
    """Of videos those that are called like the camera, unless it is the number of a stream in each.

    Raises:
        RecordingImportError: None is called so.
    """
    if camera is None or camera.isdecimal() or not found or {source.kind for source in found} != {Kind.VIDEO}:
        return found
    chosen = [source for source in found if camera_file(source.path, camera)]
    if not chosen:
        names = list(dict.fromkeys(source.path.stem for source in found))
        more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
        raise RecordingImportError(
            f"no video in {str(folder)!r} is called {camera!r}; '--camera' names video files without their suffix, "
            f"with '#' for each number or as they are, or the number of a stream in them. The files are: "
            f"{', '.join(names[:_SHOWN])}{more}."
        )
    return chosen


def _no_folder_of(camera: str, folder: Path, others: Sequence[Path]) -> RecordingImportError:
    """The error for pictures that are there, and none of which is a camera's."""
    name, pattern = folder_and_pattern(camera)
    if pattern is not None and name is None:
        return RecordingImportError(
            f"no pictures in {str(folder)!r} are called {pattern!r}, where '#' is a number; in {str(others[0])!r} are:"
            f"{listed_patterns(patterns_in(others[0]))}"
        )
    where = "in it" if others == [folder] else f"in folders in it ({', '.join(one.name for one in others[:_SHOWN])})"
    return RecordingImportError(
        f"no folder in {str(folder)!r} is called {camera!r}; '--camera' names the folder that the pictures are in. "
        f"There are pictures {where}: leave out '--camera' to import them."
    )


def _suffix_kind(file: Path) -> Kind | None:
    name = file.name.lower()
    return next((kind for suffix, kind in SUFFIXES.items() if name.endswith(suffix)), None)


def _is_empty(path: Path) -> bool:
    """Whether a path is a file without any content, as an interrupted copy or a full disk leaves it."""
    try:
        return path.is_file() and not path.stat().st_size
    except OSError:
        return False


def _empty(file: Path, others: Sequence[Source], is_skipped: bool) -> RecordingImportError:
    way_out = ", or leave it out with '--skip-damaged'" if others else ", or name another recording"
    return RecordingImportError(
        f"{str(file)!r} is empty: nothing was recorded, or its content was not copied. Copy it again"
        f"{'' if others and is_skipped else way_out}."
    )


def _told_of_empty(files: Sequence[Path]) -> str:
    names = ", ".join(repr(str(file)) for file in files[:_SHOWN])
    more = f" and {len(files) - _SHOWN} more" if len(files) > _SHOWN else ""
    return f"{'1 file is' if len(files) == 1 else f'{len(files)} files are'} empty and left out: {names}{more}."


def _unreadable(folder: Path, error: OSError) -> RecordingImportError:
    kind = "the folder " if folder.is_dir() else ""
    return RecordingImportError(f"cannot read {kind}{str(folder)!r}: {error.strerror}.")


def _nothing_in(folder: Path, camera: str | None) -> RecordingImportError:
    if any(folder.glob("*.db3*")):
        return RecordingImportError(f"{str(folder)!r} is a ROS 2 bag in SQLite; {CONVERT_BAG}.")
    over = _passed_over(folder, Taken(whole=frozenset(), pictures=frozenset(), chosen=frozenset()))
    deeper = ""
    if over.readable:
        which = "" if camera else ", or with '--camera NAME' the folder in each of them that the pictures are in"
        deeper = f" Recordings or pictures lie deeper in it: {over.listed(over.readable)}. Name these folders{which}."
    elif over.foreign:
        deeper = f" {over.foreign_sentence()}"
    elif (arrays := arrays_in(folder)) is not None:
        deeper = f" {str(arrays[0].relative_to(folder))!r} in it holds {arrays[1]}, {NOT_READ}."
    return RecordingImportError(
        f"{str(folder)!r} holds no recording: no {KNOWN}, no pictures ({' '.join(PICTURES)}), and it is no LeRobot "
        f"data set.{deeper}"
    )

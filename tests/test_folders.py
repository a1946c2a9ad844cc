"""Folders that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthaug import InputError
from orthaug._base import folders as partials
from orthaug._base.folders import check_new_file, check_replaceable, whole_file, whole_folder


def listing(folder: Path) -> list[str]:
    """Everything below a folder but its manifest, hidden files too."""
    names = sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))
    return [name for name in names if Path(name).name != "manifest.json"]


def write(folder: Path, text: str = "new", extra: str | None = None) -> None:
    with whole_folder(folder) as partial:
        (partial / "ours").write_text(text)
        if extra:
            (partial / extra).write_text(text)


@pytest.mark.parametrize("name", ["out", "a/b/out", "out with spaces", ".hidden", "über"])
def test_a_new_folder_appears_with_its_parents(tmp_path, name):
    write(tmp_path / name)
    assert (tmp_path / name / "ours").read_text() == "new"
    assert len([entry for entry in listing(tmp_path) if entry.endswith("ours")]) == 1
    assert not [entry for entry in listing(tmp_path) if "partial" in entry or "old" in entry]


def test_the_folder_can_be_read_by_others(tmp_path):
    write(tmp_path / "out")
    assert (tmp_path / "out").stat().st_mode & 0o777 == 0o755


def test_a_relative_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("a/out"))
    assert listing(tmp_path) == ["a", "a/out", "a/out/ours"]


def test_an_empty_folder_is_taken(tmp_path):
    (tmp_path / "out").mkdir()
    write(tmp_path / "out")
    assert listing(tmp_path) == ["out", "out/ours"]


def test_ours_is_replaced_whole(tmp_path):
    write(tmp_path / "out", "old", extra="stale")
    write(tmp_path / "out", "new")
    assert listing(tmp_path) == ["out", "out/ours"]
    assert (tmp_path / "out" / "ours").read_text() == "new"


def test_nothing_is_there_before_the_end(tmp_path):
    with whole_folder(tmp_path / "out") as partial:
        assert not (tmp_path / "out").exists()
        assert partial.parent == tmp_path
        (partial / "ours").touch()
    assert (tmp_path / "out").exists()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_interrupted_write_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_folder(tmp_path / "a" / "b" / "out") as partial:
        (partial / "ours").touch()
        raise error
    assert listing(tmp_path) == []


def test_an_interrupted_write_keeps_what_was_there(tmp_path):
    write(tmp_path / "out", "old")
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "out") as partial:
        (partial / "ours").write_text("half")
        raise KeyboardInterrupt
    assert listing(tmp_path) == ["out", "out/ours"]
    assert (tmp_path / "out" / "ours").read_text() == "old"


def test_a_rename_that_fails_keeps_what_was_there(tmp_path, monkeypatch):
    """The old folder is moved away before the new one takes its place; if that fails it must come back."""
    write(tmp_path / "out", "old")
    rename = Path.rename

    def fail(self: Path, target: Path) -> Path:
        if "partial" in self.name:
            raise OSError("no")
        return rename(self, target)

    monkeypatch.setattr(Path, "rename", fail)
    with pytest.raises(InputError, match=r"out: cannot be written \(no\)"):
        write(tmp_path / "out", "new")
    assert listing(tmp_path) == ["out", "out/ours"]
    assert (tmp_path / "out" / "ours").read_text() == "old"


def test_something_else_is_refused_and_kept(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    message = (
        "out: holds thesis.txt and no manifest.json that says orthaug wrote it; give another "
        "folder, or .* with --force"
    )
    with pytest.raises(InputError, match=message):
        check_replaceable(tmp_path / "out")
    with pytest.raises(InputError, match=message):
        write(tmp_path / "out")
    assert listing(tmp_path) == ["out", "out/thesis.txt"]


def test_a_file_in_its_place_is_refused(tmp_path):
    (tmp_path / "out").write_text("mine")
    with pytest.raises(InputError, match="out: not a folder; give another name"):
        write(tmp_path / "out")


def test_a_dangling_link_in_its_place_is_refused(tmp_path):
    (tmp_path / "out").symlink_to(tmp_path / "absent")
    with pytest.raises(InputError, match="out: not a folder"):
        write(tmp_path / "out")


@pytest.mark.parametrize("below", ["file/out", "file/a/b/out"])
def test_a_parent_that_is_a_file(tmp_path, below):
    (tmp_path / "file").write_text("mine")
    with pytest.raises(InputError, match="out: cannot be written; .*file is not a folder"):
        write(tmp_path / below)


def test_a_parent_that_cannot_be_written(tmp_path, monkeypatch):
    """As the operating system says it; a test that runs as root is not refused otherwise."""

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("orthaug._base.folders.tempfile.mkdtemp", refuse)
    with pytest.raises(InputError, match=r"out: cannot be written \(Permission denied in "):
        write(tmp_path / "out")
    assert listing(tmp_path) == []


def test_a_check_leaves_nothing_behind(tmp_path):
    check_replaceable(tmp_path / "a" / "out")
    assert listing(tmp_path) == []


# --- only what orthaug wrote and nobody changed is replaced


def add_note(folder: Path) -> None:
    (folder / "note.txt").write_text("mine")


def change(folder: Path) -> None:
    (folder / "ours").write_text("mine")


def link(folder: Path) -> None:
    (folder / "deep").symlink_to(folder.parent)


def exchange(folder: Path) -> None:
    (folder / "manifest.json").write_text('{"name": "of a page"}')


@pytest.mark.parametrize(
    ("alter", "words"),
    [
        (add_note, "note.txt, which orthaug did not write"),
        (change, "ours, which was changed since orthaug wrote it"),
        (link, "deep, which orthaug did not write"),
        (exchange, "manifest.json and no manifest.json that says orthaug wrote it"),
    ],
)
def test_a_result_with_something_else_is_kept_unless_forced(tmp_path, alter, words):
    write(tmp_path / "out", "old")
    alter(tmp_path / "out")
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    with pytest.raises(InputError, match=f"out: holds {words}; .* --force"):
        write(tmp_path / "out")
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before
    with whole_folder(tmp_path / "out", force=True) as partial:
        (partial / "ours").write_text("new")
    assert listing(tmp_path) == ["out", "out/ours"]


def test_a_note_that_is_added_meanwhile_is_kept(tmp_path):
    write(tmp_path / "out", "old")
    with pytest.raises(InputError, match="note.txt"), whole_folder(tmp_path / "out") as partial:
        (partial / "ours").write_text("new")
        add_note(tmp_path / "out")
    assert listing(tmp_path) == ["out", "out/note.txt", "out/ours"]


def test_what_file_managers_add_is_nobodys(tmp_path):
    write(tmp_path / "out", "old")
    (tmp_path / "out" / ".DS_Store").touch()
    check_replaceable(tmp_path / "out")


def test_without_a_manifest_every_file_is_the_users(tmp_path):
    """A name says nothing about who wrote a file: what older versions wrote is kept, too."""
    write(tmp_path / "out", "old")
    (tmp_path / "out" / "manifest.json").unlink()
    with pytest.raises(
        InputError,
        match="out: holds ours and no manifest.json that says orthaug wrote it; .*--force",
    ):
        check_replaceable(tmp_path / "out")
    assert (tmp_path / "out" / "ours").read_text() == "old"


def test_a_run_that_replaces_what_another_wrote_meanwhile_is_noted(tmp_path):
    folder = tmp_path / "out"
    write(folder, "old")
    partials.remember(folder)
    write(folder, "same run")
    assert folder not in partials.PARTIALS.overtaken
    partials.remember(folder)
    seen = dict(partials.PARTIALS.seen)
    write(folder, "another run")
    partials.PARTIALS.seen.update(seen)
    write(folder, "this run")
    assert folder in partials.PARTIALS.overtaken and (folder / "ours").read_text() == "this run"


def test_the_target_of_a_link_is_replaced(tmp_path):
    write(tmp_path / "out", "old")
    (tmp_path / "link").symlink_to("out")
    write(tmp_path / "link", "new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "out" / "ours").read_text() == "new"


@pytest.mark.parametrize("place", [".", "..", "../.."])
def test_nobody_is_left_without_a_folder(tmp_path, monkeypatch, place):
    (tmp_path / "a" / "b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a" / "b")
    with pytest.raises(InputError, match="is or holds the working folder"):
        check_replaceable(Path(place), force=True)


# --- files


def put(path: Path, text: str = "new", **options: bool) -> None:
    with whole_file(path, **options) as partial:
        partial.write_text(text)


def test_a_file_is_replaced_only_by_force(tmp_path):
    put(tmp_path / "a.csv", "old")
    with pytest.raises(
        InputError, match=r"a.csv: exists; give another name, or replace it with --force"
    ):
        check_new_file(tmp_path / "a.csv")
    with pytest.raises(InputError, match=r"a.csv: exists and holds something else"):
        put(tmp_path / "a.csv")
    assert (tmp_path / "a.csv").read_text() == "old" and listing(tmp_path) == ["a.csv"]
    put(tmp_path / "a.csv", "old")  # as another process that does the same
    (tmp_path / "link").symlink_to("a.csv")
    put(tmp_path / "link", force=True)
    assert (tmp_path / "link").is_symlink() and (tmp_path / "a.csv").read_text() == "new"
    put(tmp_path / ("x" * 255))
    assert len(listing(tmp_path)) == 3


def test_a_pipe_is_written_into():
    put(Path("/dev/null"))
    assert Path("/dev/null").is_char_device()


def test_a_disk_without_space(tmp_path):
    def fail(place: Path) -> None:
        (place / "half").touch() if place.is_dir() else place.touch()
        raise OSError(28, "No space left on device")

    for whole in (lambda: whole_folder(tmp_path / "out"), lambda: whole_file(tmp_path / "out")):
        with (
            pytest.raises(InputError, match=r"out: cannot be written \(No space left on device\)"),
            whole() as partial,
        ):
            fail(partial)
    assert listing(tmp_path) == []


# --- what dead processes leave


def test_what_a_dead_process_left_is_removed(tmp_path, monkeypatch):
    def dead(name: str) -> str:
        host, process, rest = name.split("-")[-3:]
        return f"{name.removesuffix(f'{host}-{process}-{rest}')}{host}-{2**22 + 1}-{rest}"

    monkeypatch.setattr(partials, "_name", lambda kind, name=partials._name: dead(name(kind)))
    gone = partials.Partials()
    (gone.folder(tmp_path) / "half").touch()
    gone.file(tmp_path)
    old = gone.shelter(tmp_path)
    (old / "result").mkdir()
    (old / "result" / "ours").write_text("old")
    monkeypatch.undo()
    other_machine = tmp_path / ".orthaug-partial-00000000-7-0"
    other_machine.mkdir()
    alive = partials.Partials().file(tmp_path)
    partials.remove_stale(tmp_path, [alive])
    assert listing(tmp_path) == sorted([other_machine.name, alive.name, "result", "result/ours"])


def test_a_signal_removes_what_is_partial(tmp_path):
    mine = partials.Partials()
    made = tmp_path / "deep"
    made.mkdir()
    (mine.folder(made, [made]) / "half").touch()
    mine.file(tmp_path)
    mine.discard_all()
    assert listing(tmp_path) == []

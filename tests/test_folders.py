"""Folders that appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from orthaug._base.errors import InputError
from orthaug._base.folders import check_replaceable, whole_folder


def is_ours(folder: Path) -> bool:
    return (folder / "ours").exists()


def listing(folder: Path) -> list[str]:
    """Everything below a folder, hidden files too."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*"))


def write(folder: Path, text: str = "new", extra: str | None = None) -> None:
    with whole_folder(folder, is_ours) as partial:
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
    with whole_folder(tmp_path / "out", is_ours) as partial:
        assert not (tmp_path / "out").exists()
        assert partial.parent == tmp_path
        (partial / "ours").touch()
    assert (tmp_path / "out").exists()


@pytest.mark.parametrize("error", [RuntimeError, KeyboardInterrupt, SystemExit])
def test_an_interrupted_write_leaves_nothing(tmp_path, error):
    with pytest.raises(error), whole_folder(tmp_path / "a" / "b" / "out", is_ours) as partial:
        (partial / "ours").touch()
        raise error
    assert listing(tmp_path) == []


def test_an_interrupted_write_keeps_what_was_there(tmp_path):
    write(tmp_path / "out", "old")
    with pytest.raises(KeyboardInterrupt), whole_folder(tmp_path / "out", is_ours) as partial:
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
    with pytest.raises(OSError):
        write(tmp_path / "out", "new")
    assert listing(tmp_path) == ["out", "out/ours"]
    assert (tmp_path / "out" / "ours").read_text() == "old"


def test_something_else_is_refused_and_kept(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.txt").write_text("mine")
    message = "out: holds something that is not an orthaug result; give another folder, or empty it"
    with pytest.raises(InputError, match=message):
        check_replaceable(tmp_path / "out", is_ours)
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
    check_replaceable(tmp_path / "a" / "out", is_ours)
    assert listing(tmp_path) == []

"""What a wrong input must come to: one sentence, and nothing left behind."""

from pathlib import Path


def snapshot(folder: Path) -> set[tuple[Path, int, int]]:
    """Every file and folder below, with size and time of change; compiled modules are Python's own."""
    found = ((path, path.lstat()) for path in folder.rglob("*") if "__pycache__" not in path.parts)
    found = ((path, status) for path, status in found if not (path / "__pycache__").exists())
    return {(path, status.st_size if path.is_file() else 0, status.st_mtime_ns) for path, status in found}


def checked(err: str, *, program: str, left: object) -> str:
    """The sentence: the only line, of the program's own, with the sign of no traceback."""
    lines = [one for one in err.splitlines() if not one.endswith(": opening what they need")]  # progress
    assert len(lines) == 1, err
    assert lines[0].startswith(f"{program}: ")
    assert not left, "a failed start left something behind"
    sentence = lines[0].removeprefix(f"{program}: ")
    assert "Traceback" not in sentence
    assert "Errno" not in sentence
    return sentence

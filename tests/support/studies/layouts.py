"""Small datasets in the real layouts, with drawn pictures: a red square that moves seven pixels a frame."""

from pathlib import Path

import cv2

from media.clips import smooth_pictures

SIZE = (160, 96)


def square_xywh(index: int) -> tuple[int, int, int, int]:
    """Where the square of frame ``index`` is, pixels from 0."""
    return (7 * index) % (SIZE[0] - 40), SIZE[1] // 3, 32, 32


def write_images(folder: Path, count: int, *, name: str = "{:07d}.png", first: int = 1) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for number, picture in enumerate(smooth_pictures(count, size=SIZE), start=first):
        assert cv2.imwrite(str(folder / name.format(number)), picture)


def write_visdrone(root: Path, *names: str, count: int = 6, rows: str | None = None) -> None:
    """VID and MOT: the square is a van, and beside it lie all kinds of things that do not count."""
    for name in names:
        write_images(root / "sequences" / name, count)
        lines = []
        for index in range(count):
            x, y, w, h = square_xywh(index)
            lines += [
                f"{index + 1},7,{x},{y},{w},{h},1,5,0,1",
                f"{index + 1},8,140,10,30,10,1,4,1,0",  # leaves the frame
            ]
        lines += [
            "2,9,100,60,20,20,0,0,0,0",  # a region that nobody has labelled
            "2,10,102,62,10,10,1,1,0,0",  # within it
            "2,11,5,80,8,8,1,11,0,2",  # others
            "2,12,20,80,8,8,0,4,0,2,",  # does not count; and a comma too many, as in the real files
            "2,13,30,80,0,8,1,4,0,0",  # nothing
        ]
        (root / "annotations").mkdir(exist_ok=True)
        (root / "annotations" / f"{name}.txt").write_text("\n".join(lines) + "\n" if rows is None else rows)


def write_uavdt(root: Path, name: str = "M0203", *, count: int = 6, whole: bool = True) -> None:
    """As the downloads unpack, side by side; the square is a bus."""
    write_images(root / "UAV-benchmark-M" / name, count, name="img{:06d}.png")
    truth = root / "UAV-benchmark-MOTD_v1.0" / "GT"
    truth.mkdir(parents=True, exist_ok=True)
    boxes = [(index + 1, *square_xywh(index)) for index in range(count)]
    if whole:
        text = "".join(f"{n},1,{x},{y},{w},{h},{2 if n == 1 else 1},2,3\n" for n, x, y, w, h in boxes)
        (truth / f"{name}_gt_whole.txt").write_text(text)
    (truth / f"{name}_gt.txt").write_text(
        "".join(f"{n},1,{x},{y},{w},{h},1,1,-1\n" for n, x, y, w, h in boxes)
    )
    (truth / f"{name}_gt_ignore.txt").write_text("3,1,100,0,70,20,1,-1,-1\n3,1,0,0,30,10,1,-1,-1\n")
    (root / "M_attr" / "test").mkdir(parents=True, exist_ok=True)
    (root / "M_attr" / "test" / f"{name}_attr.txt").write_text("0,0,1,1,0,0,0,1,1,0\n")


def write_mot(folder: Path, *, count: int = 6, rows: str | None = None, info: str | None = None) -> None:
    """One sequence at 25 frames a second; the square is a pedestrian, pixels count from 1."""
    write_images(folder / "img1", count, name="{:06d}.png")
    usual = f"[Sequence]\nname={folder.name}\nimDir=img1\nframeRate=25\nseqLength={count}\nimExt=.png\n"
    (folder / "seqinfo.ini").write_text(usual if info is None else info)
    boxes = [(index + 1, *square_xywh(index)) for index in range(count)]
    text = "".join(f"{n},4,{x + 1},{y + 1},{w},{h},1,1,0.6\n" for n, x, y, w, h in boxes)
    text += "2,5,11,11,9,9,0,3,1\n2,6,31,11,9,9,1,8,1\n2,7,51,11,9,9,0,9,1\n"
    (folder / "gt").mkdir(exist_ok=True)
    (folder / "gt" / "gt.txt").write_text(text if rows is None else rows)

"""From rows of a study to its tables and pages: what counts, what is compared with what, and what is said of it."""

import json
import math
import re
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from matplotlib.figure import Figure

from hvt_common.errors import UserError
from hvt_study import cli
from hvt_study.datasets.class_map import map_classes
from hvt_study.datasets.labels import FrameLabels
from hvt_study.datasets.sequence import Sequence
from hvt_study.flights.flight import fly
from hvt_study.flights.flight_ground import SharedModels
from hvt_study.metrics.bits import in_accounting
from hvt_study.report import tables
from hvt_study.report.data.arms import Arm, settings
from hvt_study.report.data.document import Drawing, Pictures
from hvt_study.report.data.pairs import equal_quality, needed_bps, pairs
from hvt_study.report.data.table_file import read_results, write_results
from hvt_study.report.example.choice import (
    CropExample,
    Example,
    Lane,
    Timeline,
    Word,
    choose_run,
    load_example,
    percentile_rows,
    save_example,
)
from hvt_study.report.example.fly_again import example_of
from hvt_study.report.figures.curve_figures import utility_figure
from hvt_study.report.make import make_report
from hvt_study.report.write import html_page, write_report
from hvt_study.runs.run_context import RunContext
from hvt_study.runs.spec import COLUMNS
from rigs.flight import SIZE, RedSquares, grainy_pictures, square_box
from studies.metric_frames import clip_of, flight_plan
from studies.study_rows import column, row, study


def test_the_table_comes_back_as_it_was_written(tmp_path):
    """Everyone reads results.parquet with their own tools: its types, order, nulls and descriptions are its API."""
    path = tmp_path / "results.parquet"
    rows = [
        row("a", "M5", 600_000, 0.5, stills=3, hota=math.nan, first_correct_p90_s=math.inf),
        row("b", "M0", np.int64(5), np.float64(0.25), matched=np.bool_(False), failed="no: it cannot"),
    ]
    write_results(rows, path)
    table = pq.read_table(path)
    assert table.column_names == [one.name for one in COLUMNS]
    types = {"text": pa.string(), "int": pa.int64(), "real": pa.float64(), "yes": pa.bool_()}
    assert [field.type for field in table.schema] == [types[one.type] for one in COLUMNS]
    said = table.schema.field("map_50").metadata[b"description"]
    assert said.startswith(b"COCO mAP at IoU 0.5")
    first, second = read_results(path)
    known = {"total_bps": 600_000, "stills": 3, "hota": None, "first_correct_p90_s": math.inf}
    known |= {"target_bps": None, "matched_to": ""}
    assert {name: first[name] for name in known} == known
    assert (second["named_f1"], second["matched"], second["failed"]) == (0.25, False, "no: it cannot")
    assert [one.name for one in tmp_path.iterdir()] == ["results.parquet"]


def test_what_was_there_stays_until_the_new_table_is_whole(tmp_path, monkeypatch):
    """A full disk at the end of a night of flights would take the last table with it, too."""
    path = tmp_path / "results.parquet"
    write_results([row("a", "M0", 1, 0.5)], path)

    def full(file, _):
        file.touch()
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.raises(UserError, match=r"cannot be written.*No space left"):
        write_results([row("b", "M0", 2, 0.5)], path)
    assert [one["sequence"] for one in read_results(path)] == ["a"]
    assert [one.name for one in tmp_path.iterdir()] == ["results.parquet"]


def _damaged(path):
    write_results(study(), path)
    path.write_bytes(path.read_bytes()[:-40])


def _retyped(path):
    write_results(study()[:1], path)
    table = pq.read_table(path)
    at = table.column_names.index("total_bps")
    pq.write_table(table.set_column(at, "total_bps", pa.array(["many"])), path)


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda path: None, "does not exist"),
        (_damaged, "cannot be read as Parquet"),
        (lambda path: path.write_text("sequence,method\n"), "cannot be read as Parquet"),
        (
            lambda path: pq.write_table(pa.table({"sequence": ["a"], "other": [1]}), path),
            "has no column key, dataset, labels, method and",
        ),
        (_retyped, "column of another type"),
    ],
)
def test_a_wrong_table_gets_one_sentence(tmp_path, capsys, make, says):
    """A traceback of a library does not say which file is wrong, nor what to do."""
    make(tmp_path / "results.parquet")
    assert cli.main(["report", str(tmp_path)]) == 2
    error = capsys.readouterr().err
    assert says in error
    assert str(tmp_path / "results.parquet") in error
    assert error.count("\n") == 1
    assert not (tmp_path / "report.html").exists()


def test_means_are_of_the_runs_that_count():
    """A failed run in an average is a wrong average."""
    (setting,) = settings(study())
    table = tables.named_table(setting)
    assert [(cells[1].text, cells[3].text) for cells in table.rows] == [("M0", "3 of 5"), ("M5", "4 of 5")]
    assert "Means of fewer sequences (n) are not to be compared" in table.caption
    assert [cell.text for cell in column(table, "named F1")] == ["0.900", "0.450"]  # (.5 + .6 + .7 + 0) / 4
    assert "5 sequences; labels: annotations" in table.caption
    # Neither of the followers is an arm of its own: R0 was flown at the totals of M5 only.
    spent = tables.spent_table(setting)
    assert [cell.text for cell in column(spent, "total, kbps")] == ["800.0", "600.0"]
    assert [cell.text for cell in column(spent, "stills / 2nd pass, kbps")] == ["\N{EN DASH}", "90.0"]
    assert column(spent, "stills / 2nd pass, kbps")[1].under == "n = 3"  # the fourth does not know it


def test_differences_are_of_pairs_at_matched_totals():
    """Against M0 at the whole budget M5 would lose; against the same bits it wins: that is the study's question."""
    (setting,) = settings(study())
    against_m0, against_r0 = pairs(setting)
    assert (against_m0.reference, against_r0.reference) == ("M0", "R0")
    gaps = against_m0.gaps("named_f1")
    assert gaps == pytest.approx({"demo:0-9#a": 0.1, "demo:0-9#b": 0.2, "demo:0-9#c": 0.3})
    assert against_m0.interval("named_f1").mean == pytest.approx(0.2)
    assert against_r0.interval("named_f1").mean == pytest.approx(-0.1)
    assert against_m0.most_off_pct() == pytest.approx(100 / 600)
    table = tables.differences_table(setting, [against_m0, against_r0])
    assert [cell.text for cell in column(table, "n")] == ["3 of 4", "3 of 4"]
    assert [cell.text for cell in column(table, "Δ named F1")] == ["+0.200", "\N{MINUS SIGN}0.100"]
    assert [cell.text for cell in column(table, "ahead")] == ["3 : 0", "0 : 3"]
    assert [cell.text for cell in column(table, "kbps")] == ["600.0 / 601.0", "600.0 / 599.0"]
    assert not any(cell.strong for cell in column(table, "Δ named F1"))


def test_who_is_behind_video_is_not_said_to_be_ahead():
    """The first sentence of a report whose every method loses named the one "furthest ahead"."""
    behind = [one | {"named_f1": 0.8} if one["matched_to"] else one for one in study()]
    said = "No method is ahead of video at the same bits; the nearest is M5 jpeg in the low regime, "
    assert said + "\N{MINUS SIGN}0.200 named F1 (n = 3)." in str(make_report(behind).sections[0].parts[0])


def test_where_video_misses_the_bits_of_a_method_there_is_no_answer():
    """It was left out without a word, and "the totals of no pair are more than 0.00 % apart"."""
    missed = [one | {"failed": "spends less"} if one["matched_to"] else one for one in study()]
    first, *_ = make_report(missed).sections
    (said,) = first.parts
    assert first.title == "The answer"
    assert str(said).endswith("beside M5 jpeg, low: of these there is no answer.")
    (setting,) = settings(missed)
    assert "No pair counts. " in tables.differences_table(setting, list(pairs(setting))).caption


def test_runs_of_other_networks_and_labels_are_never_averaged_together():
    """Reference labels say how much survives, annotations what is right: one mean of both says nothing."""
    rows = [
        row("a", "M0", 1, 0.2),
        row("a", "M0", 1, 0.4, labels="reference"),
        row("a", "M0", 1, 0.6, detector="large"),
        row("a", "M0", 1, 0.8, dataset="clips:/data/x.mp4"),
    ]
    found = settings(rows)
    assert [(one.name, one.labels, one.models.detector, len(one.rows)) for one in found] == [
        ("all 2 datasets", "annotations", "nano", 2),
        ("demo 0-9", "annotations", "nano", 1),
        ("clips x.mp4", "annotations", "nano", 1),
        ("demo 0-9", "reference", "nano", 1),
        ("demo 0-9", "annotations", "large", 1),
    ]
    means = [column(tables.named_table(one), "named F1")[0].text for one in found]
    assert means == ["0.500", "0.200", "0.800", "0.400", "0.600"]
    assert (
        "labels: reference (the detector on source frames before they are coded"
        in tables.named_table(found[3]).caption
    )
    assert "2 sequences of demo 0-9, clips x.mp4; labels" in tables.named_table(found[0]).caption


def test_failed_runs_are_named_with_their_reason():
    """What is in no average has to be somewhere."""
    table = tables.failed_table(study())
    assert "(2)" in table.caption
    assert [cell.text for cell in column(table, "sequence")] == ["d", "e"]
    assert [cell.text for cell in column(table, "at the total of")] == ["M5 jpeg", "\N{EN DASH}"]
    assert [cell.text for cell in column(table, "why")] == ["spends 630000 bps", "the edge refuses"]
    assert tables.failed_table(study()[:4]) is None


def test_the_method_matrix_has_methods_by_regimes():
    """The paper's matrix, with results."""
    rows = [*study(), row("a", "M5", 1_300_000, 0.95, regime="moderate", budget_bps=1_400_000)]
    (setting,) = settings(rows)
    table = tables.matrix_table(setting, "named_f1")
    assert [head.text for head in table.heads][3:] == ["low, 800 kbps", "moderate, 1400 kbps"]
    assert [(cells[0].text, cells[3].text, cells[4].text) for cells in table.rows] == [
        ("M0", "0.900", "\N{EN DASH}"),
        ("M5", "0.450", "0.950"),
    ]
    # M0's mean is of a, b and c, M5's of d, too: neither is the higher of the two.
    assert [[cell.strong for cell in cells[3:]] for cells in table.rows] == [[False, False], [False, False]]
    assert [[cell.under for cell in cells[3:]] for cells in table.rows] == [["n = 3", ""], ["n = 4", "n = 1"]]
    (same,) = settings([one for one in rows if one["sequence"] in "abc"])
    strong = [[cell.strong for cell in cells[3:]] for cells in tables.matrix_table(same, "named_f1").rows]
    assert strong == [[True, False], [False, False]]
    assert tables.matrix_table(setting, "hota") is None


def test_bits_at_equal_accuracy_are_read_between_points_only():
    """Beyond the bits that were flown nobody knows: a number there would be an invention."""
    curve = [(400e3, 0.4), (100e3, 0.2), (1600e3, 0.3)]
    assert needed_bps(curve, level=0.3) == pytest.approx(200e3)  # half way of the logarithm
    assert needed_bps(curve, level=0.4) == pytest.approx(400e3)
    assert needed_bps(curve, level=0.41) == math.inf
    assert needed_bps(curve, level=0.1) == 0
    assert math.isnan(needed_bps(curve[:1], level=0.3))
    (setting,) = settings(study())
    one = equal_quality(setting, Arm("low", "M5", "jpeg"), reference="M0", column="named_f1")
    # M0 has 0.4 at 601 kbps and 0.9 at 800; sequence d has no curve.
    share = [(level - 0.4) / 0.5 for level in (0.5, 0.6, 0.7)]
    assert one.ratios == pytest.approx([601 * (800 / 601) ** part / 600 for part in share])
    assert one.median == pytest.approx(one.ratios[1])
    assert (one.above, one.below, one.unread) == (0, 0, 1)


def test_which_flight_is_shown_is_decided_by_rule():
    """A flight that was picked by eye shows what its author likes."""
    choice = choose_run(study())
    assert choice.key == "b-M5-600000"  # gains .1, .2, .3
    assert "M5 jpeg" in choice.rule
    assert "median gain" in choice.rule
    assert choose_run([row("a", "M0", 1, 0.5)]) is None
    assert percentile_rows([5.0, 1.0, 4.0, 2.0, 3.0]) == [(10, 1), (50, 4), (90, 0)]
    assert percentile_rows([7.0]) == [(50, 0)]
    assert percentile_rows([]) == []


def example(key):
    png = cv2.imencode(".png", np.full((4, 6, 3), 90, np.uint8))[1].tobytes()
    told = Timeline(
        budget_bps=800_000,
        base_kbps=(600.0, 500.0),
        roi_kbps=(100.0, 90.0),
        other_kbps=(1.0, 2.0),
        f1=(0.5, math.nan),
        named_before=(0.4, 0.4),
        named=(0.4, 0.6),
        lanes=(Lane(7, ((0.0, 1.5),), (Word(0.8, "car", "bus"), Word(1.2, "bus", "bus"))),),
        tracks_named=1,
    )
    crop = CropExample(50, 6.5, 28.0, 0.4, 7, "car", "bus", 1234, png, png, png)
    return Example(key, "", "by rule", "demo-0, M5 jpeg", 9, (crop,), told)


def test_an_example_is_kept_beside_the_table(tmp_path):
    """Flying again takes minutes; making the report again must not."""
    assert load_example(tmp_path) is None
    save_example(tmp_path, example("k"))
    back = load_example(tmp_path)
    assert back.crops == example("k").crops
    assert back.timeline.lanes == example("k").timeline.lanes
    assert back.timeline.roi_kbps == (100.0, 90.0)
    (tmp_path / "example" / "50-base.png").unlink()
    with pytest.raises(UserError, match="lacks a picture"):
        load_example(tmp_path)
    (tmp_path / "example" / "example.json").write_text('{"key": 3}')
    with pytest.raises(UserError, match="damaged"):
        load_example(tmp_path)


def test_a_flight_flown_again_is_the_same_and_shows_its_stills(tmp_path):
    """Another flight, or a base that is shown a pixel off, would make stills look better than they are."""
    frames = 46
    clip = clip_of(grainy_pictures(frames), tmp_path)
    m5 = ("--budget", "120kbps", "--method", "M5", "--cooldown", "0s", "--still-codec", "residual")
    flight = flight_plan(clip, "--detector", "motion", *m5)
    context = run_context(clip)
    found = example_of(flight, context, key="k", rule="by rule", title="drawn")
    plain = fly(flight, detector=RedSquares(), models=SharedModels(RedSquares()))
    assert found.digest == plain.digest
    assert found.stills == plain.messages["roi"] >= 1
    assert found.crops
    for crop in found.crops:
        source, base, still = (
            cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR).astype(float)
            for png in (crop.source_png, crop.base_png, crop.still_png)
        )
        assert source.shape == base.shape == still.shape
        off = np.abs(base - source).mean()
        assert off < min(np.abs(np.roll(base, step, (0, 1)) - source).mean() for step in ((0, 1), (1, 0)))
        assert crop.base_db > 20
    told = found.timeline
    sent_bits = 1e3 * sum(map(sum, (told.base_kbps, told.roi_kbps, told.other_kbps)))
    assert sent_bits == pytest.approx(8 * sum(plain.line_bytes.values()))
    assert (len(told.f1), len(told.named), told.f1[1] > 0.9) == (4, 4, True)
    assert told.lanes
    assert all(word.at_s <= frames / 15 + 1 for lane in told.lanes for word in lane.words)


def run_context(clip):
    def labels(frame):
        return FrameLabels(np.array([square_box(frame)], np.float32), np.zeros(1, np.int64), ("car",))

    sequence = Sequence("drawn", "demo", clip, clip.frame_count, 15.0, SIZE, labels, ("bus", "car"))
    classes = map_classes(RedSquares().class_names, ("bus", "car"))
    truth = tuple(map(labels, range(clip.frame_count)))
    return RunContext(sequence, classes, RedSquares(), RedSquares(), None, {}, {}, truth, None)


def test_an_example_of_another_flight_is_not_shown():
    """Beside a table it would be taken for one of its runs."""
    rows = [row("a", "M5", 600_000, 0.5, key="k", digest="abc")]
    shown = make_report(rows, example=replace(example("k"), digest="abc"))
    assert sum(isinstance(part, Pictures) for section in shown.sections for part in section.parts) == 1
    other = make_report(rows, example=replace(example("k"), digest="other"))
    assert not any(isinstance(part, Pictures) for section in other.sections for part in section.parts)
    stray = make_report(rows, example=replace(example("not there"), digest="abc"))
    assert "One flight" not in [section.title for section in stray.sections]


@pytest.fixture(scope="module")
def written(tmp_path_factory):
    """A study's folder, with its report."""
    folder = tmp_path_factory.mktemp("study")
    rows = [
        *study(),
        *(row(name, "M5", 610_000, 0.55, still_codec="avif", mean_still_bytes=800.0) for name in "ab"),
        row("<b>&|", "M5", 9, 0.1, failed="why? <i>& | https://example.org", matched=False),
    ]
    rows[0]["versions"] = json.dumps({"hvt": "0.1.0"})
    write_results(rows, folder / "results.parquet")
    save_example(folder, example("b-M5-600000"))
    (folder / "sweep.csv").write_text("policy,selected,ratio,frame_coverage\npermissive,30,0.81,0.99\n")
    assert cli.main(["report", str(folder)]) == 0
    return folder


def test_the_page_needs_nothing_else(written):
    """It is read in the field and mailed around: a page that asks the network shows half of itself."""
    page = (written / "report.html").read_text()
    assert page.startswith("<!DOCTYPE html>")
    links = re.findall(r'(?:src|href)\s*=\s*"([^"]*)"', page) + re.findall(r"url\(([^)]*)\)", page)
    assert links
    assert all(link.startswith(("#", "data:image/png;base64,")) for link in links)
    named = re.findall(r'\bid="([^"]+)"', page)
    assert {link[1:] for link in links if link.startswith("#")} <= set(named)
    assert page.count("<svg") >= 4
    assert len(named) == len(set(named)), "two drawings with one clip path of one name cut each other off"
    assert not re.search(r"<script|<link|@import|xmlns|<iframe|<object|<i>&", page)
    # What stands in the rows is text, not markup, and the only address on the page.
    assert re.findall(r"https?://[^\s<\"]*", page) == ["https://example.org"]
    for text in ("&lt;i&gt;&amp; | https://example.org", "prefers-color-scheme: dark", "@media print"):
        assert text in page


def test_the_page_has_all_that_the_paper_has(written):
    """Selector sweep, end-to-end results, method matrix, metrics; and figures as files of their own."""
    for text in ((written / "report.html").read_text(), (written / "report.md").read_text()):
        for said in (
            *("The answer", "Selector sweep", "End-to-end results", "Method matrix", "Metrics", "One flight"),
            *("Against video at the same bits", "Utility over bitrate", "Still codecs"),
            *("Runs that do not count", "What it was run with"),
            *("+0.200 named F1", "That is no verdict", "permissive", "hvt 0.1.0"),
        ):
            assert said in text
    markdown = (written / "report.md").read_text()
    shown = re.findall(r"\]\((figures/[^)]+)\)", markdown)
    assert len(shown) >= 7
    assert all((written / name).is_file() for name in shown)
    assert {path.suffix for path in (written / "figures").iterdir()} == {".svg", ".pdf", ".png"}
    rows = [line for line in markdown.splitlines() if line.startswith("|")]
    assert all(line.endswith(" |") for line in rows)
    assert "<i>& \\| https" in markdown  # a bar within a cell parts no cells


def test_the_same_table_makes_the_same_report(written, savefig, monkeypatch):
    """A report under version control must not change when nothing did."""
    names = ("report.html", "report.md", "figures/utility-1.svg")
    before = [(written / name).read_bytes() for name in names]
    write_report(written)
    assert [(written / name).read_bytes() for name in names] == before
    monkeypatch.setattr(Figure, "savefig", savefig)
    one, other = (utility_figure(settings(study())[0], name="u").pdf for _ in range(2))
    assert one == other
    assert b"/CreationDate" not in one, "it counts seconds: two that are drawn at once have the same"
    assert b"/Type3" not in one, "printers refuse fonts of that type"


def test_a_study_of_one_method_or_none_that_counts_has_a_report():
    """The first try of every user is one sequence; the second is one where all fails."""
    alone = make_report([row("a", "M0", 800_000, 0.5)])
    assert "1 run over 1 sequence" in alone.lead[0]
    assert any(isinstance(part, Drawing) for section in alone.sections for part in section.parts)
    failed = make_report([row("a", "M0", None, failed="no", matched=False)])
    titles = [section.title for section in failed.sections]
    assert "Runs that do not count" in titles
    assert "Utility over bitrate" not in titles
    assert "Method matrix" not in titles
    assert "<h1>" in html_page(failed)
    assert "0 runs" in make_report([]).lead[0]


def test_the_pilots_accounting_divides_by_the_clip_and_changes_no_match(tmp_path):
    """Its printed rates could not be compared with ours, or ours would be taken for them."""
    rows = [
        row("a", "M5", 800_000, 0.5, accounting="span", clip_s=25.0, roi_bps=80_000, stills_per_min=60.0),
        row("a", "M0", 800_000, 0.4, accounting="span", clip_s=25.0, matched_to="M5", target_bps=800_000),
        row("b", "M5", None, failed="no", matched=False, accounting="span"),
    ]
    pilot = in_accounting(rows, "pilot")
    assert [one["total_bps"] for one in pilot] == [320_000, 320_000, None]
    rates = pilot[0]["roi_bps"], pilot[0]["stills_per_min"], pilot[1]["target_bps"]
    assert rates == (32_000, 24.0, 320_000)
    assert {one["accounting"] for one in pilot} == {"pilot"}
    assert in_accounting(pilot, "span") == rows
    assert in_accounting(pilot, "pilot") == pilot

    write_results(rows, tmp_path / "results.parquet")
    assert cli.main(["report", str(tmp_path), "--accounting", "pilot"]) == 0
    markdown = (tmp_path / "report.md").read_text()
    assert "rates by the length of the whole clip, as the pilot's" in markdown
    assert read_results(tmp_path / "results.parquet")[0]["total_bps"] == 800_000, "the table stays"


def test_several_studies_are_joined_to_one(tmp_path, capsys):
    """Who shared the sequences among machines would have as many reports as machines, and no interval."""
    one, two = tmp_path / "one", tmp_path / "two"
    for folder in (one, two):
        folder.mkdir()
    mine, other, theirs = (
        row(name, "M5", bps, f1, accounting="span", clip_s=20.0)
        for name, bps, f1 in (("a", 800_000, 0.5), ("b", 700_000, 0.6), ("c", 600_000, 0.7))
    )
    write_results([mine, other], one / "results.parquet")
    write_results(in_accounting([theirs, {**mine, "named_f1": 0.1}], "pilot"), two / "results.parquet")
    assert cli.main(["report", str(one), str(two)]) == 2
    assert "2 studies are given, and no place for the one: add --out DIR" in capsys.readouterr().err
    assert cli.main(["report", str(one), str(two), "--out", str(tmp_path / "all")]) == 0
    found = read_results(tmp_path / "all" / "results.parquet")
    totals = {line["sequence"]: line["total_bps"] for line in found}
    assert totals == {"a": 800_000, "b": 700_000, "c": 600_000}
    assert (len(found), found[0]["named_f1"]) == (3, 0.5), "of a run that both have the first counts"
    assert "3 sequences" in (tmp_path / "all" / "report.md").read_text()

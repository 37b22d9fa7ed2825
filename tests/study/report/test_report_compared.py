"""What a report may hold against what: same conditions, the very totals, the same sequences, and enough of them."""

import json
import math
import re
from dataclasses import replace

import cv2
import numpy as np
import pytest
from matplotlib.figure import Figure

from hvt_common.errors import UserError
from hvt_study import cli
from hvt_study.metrics.bits import in_accounting
from hvt_study.report.data.arms import Arm, settings
from hvt_study.report.data.captions import ENOUGH, interval_of, mean_of
from hvt_study.report.data.pairs import EqualQuality, pairs
from hvt_study.report.data.table_file import write_results
from hvt_study.report.example.choice import CropExample, Example, Timeline, choose_run
from hvt_study.report.figures.curve_figures import codec_figure, difference_figures, utility_figure
from hvt_study.report.figures.drawing import PALETTE, log_axis, rate_axis, style_of
from hvt_study.report.figures.example_figures import crop_pictures
from hvt_study.report.make import make_report
from hvt_study.report.tables import (
    differences_table,
    equal_table,
    failed_table,
    metrics_table,
    named_table,
    proxy_table,
    seen_table,
    size_table,
    spent_table,
    sweep_table,
)
from hvt_study.report.write import inline_svg, write_report
from hvt_study.runs.methods import METHODS
from studies.study_rows import column, row, study, to_m5

DASH = "\N{EN DASH}"


def config(**run):
    """As ``hvt-study run`` writes it."""
    usual = {
        "size": [1280, 720],
        "detect_every": 5,
        "max_frames": None,
        "tune": [],
        "models": {"refine": "fuse"},
    }
    return json.dumps({"run": usual | run})


def many(count, **own):
    """M5 is ahead of M0 at the same bits by 0.1 in each of so many sequences."""
    rows = []
    for name in "abcdefgh"[:count]:
        rows.append(row(name, "M5", 600_000, 0.5, **own))
        rows.append(row(name, "M0", 601_000, 0.4, **own, **to_m5(target_bps=600_000)))
    return rows


def test_runs_under_other_conditions_are_not_averaged_together():
    """Two studies joined: the last run of a sequence would take the place of the first, without a word."""
    often = [
        {**one, "key": f"{one['key']}-often", "named_f1": 0.1, "config": config(detect_every=1)}
        for one in many(2)
    ]
    for rows in (many(2) + often, often + many(2)):
        found = {one.conditions.detect_every: one for one in settings(rows)}
        assert set(found) == {5, 1}
        assert [cell.text for cell in column(named_table(found[5]), "named F1")] == ["0.500"]
        assert [cell.text for cell in column(named_table(found[1]), "named F1")] == ["0.100"]
        assert "detection on every frame" in named_table(found[1]).caption
        assert "detection" not in named_table(found[5]).caption


@pytest.mark.parametrize(
    ("other", "says"),
    [
        ({"size": [960, 540]}, "base of 960x540"),
        ({"max_frames": 90}, "at most 90 frames of each"),
        ({"models": {"refine": "replace"}}, "--refine replace"),
    ],
)
def test_captions_say_which_conditions_are_not_the_usual(other, says):
    """A table of ninety frames at a quarter of the size looks like one of whole flights."""
    rows = [row("a", "M5", 1, 0.5, config=config()), row("a", "M5", 1, 0.4, key="k", config=config(**other))]
    usual, unusual = settings(rows)
    assert says in seen_table(unusual).caption
    assert says not in seen_table(usual).caption


def test_what_was_tuned_is_said():
    """Weights that were searched for are not the method as it comes, nor half of its mean."""
    (setting,) = settings([row("a", "M5", 1, 0.5, config=config(tune=["area=2"])), row("a", "M0", 1, 0.4)])
    assert "M5 with area=2" in seen_table(setting).caption
    rows = [row("a", "M5", 1, 0.5), row("b", "M5", 1, 0.5, config=config(tune=["area=2"]))]
    with pytest.raises(UserError, match=r"runs of M5 with other parameters .* \(its defaults and area=2\)"):
        settings(rows)


def test_two_different_runs_at_one_place_are_refused(tmp_path, capsys):
    """Which of them counts would hang on the order in which the folders were named."""
    one, two, out = tmp_path / "one", tmp_path / "two", tmp_path / "all"
    for folder, tune in ((one, []), (two, ["area=2"])):
        folder.mkdir()
        rows = [row("a", "M5", 600_000, 0.5, key=folder.name, config=config(tune=tune))]
        write_results(rows, folder / "results.parquet")
    assert cli.main(["report", str(one), str(two), "--out", str(out)]) == 2
    error = capsys.readouterr().err
    assert "two runs of M5 jpeg on a, low regime, count and are not the same (tune: none and area=2)" in error
    assert error.count("\n") == 1
    assert not out.exists()


def test_software_that_differs_is_named_where_nothing_else_does():
    """Two machines with other libraries: the same flight, and other bytes."""
    rows = [
        row("a", "M5", 1, 0.5, key=version, versions=json.dumps({"libavcodec": version}))
        for version in ("60", "61")
    ]
    with pytest.raises(UserError, match=r"libavcodec: 60 and 61"):
        settings(rows)
    # The same run twice is one, and a run that counts nowhere takes nobody's place.
    settings([rows[0], dict(rows[0])])
    settings([rows[0], {**rows[1], "matched": False}])


def test_files_that_were_replaced_under_their_names_are_told():
    """M5 with a network, and M6 with what was trained since under the same name: no figure of theirs compares."""
    old, new = (json.dumps({"clip": "c", "detector": one, "edge_detector": one}) for one in ("1", "2"))
    rows = [row("a", "M5", 1, 0.5, content=old), row("a", "M6", 1, 0.5, content=new)]
    said = [
        [part for part in make_report(both).sections[-1].parts if "other content" in part]
        for both in (rows, rows[:1])
    ]
    assert said == [["Files of one name and other content are mixed here: nano."], []]


def test_a_follower_of_another_total_is_no_match():
    """From another machine's run of that name: video with a fifth more bits would pass for the same bits."""
    rows = [
        row("a", "M5", 600_000, 0.5),
        row("a", "M0", 720_000, 0.9, **to_m5(target_bps=720_000)),
        row("b", "M5", 600_000, 0.5),
        row("b", "M0", 720_000, 0.9, **to_m5(target_bps=720_000)),
        row("b", "M0", 601_000, 0.4, **to_m5(target_bps=600_000)),
    ]
    for ordered in (rows, rows[::-1]):
        (setting,) = settings(ordered)
        (pair,) = pairs(setting)
        assert pair.gaps("named_f1") == pytest.approx({"demo:0-9#b": 0.1})
        assert pair.most_off_pct() < 1
        said = "2 runs of video were coded to the total of a run that is not the one"
        assert said in make_report(ordered).lead[1]
    assert not any("coded to the total" in text for text in make_report([rows[2], rows[4]]).lead)
    # Rounded on its way through the other accounting, a total is still the same.
    back = in_accounting(in_accounting([{**one, "clip_s": 33.0} for one in rows], "pilot"), "span")
    (pair,) = pairs(settings([rows[2] | {"clip_s": 33.0}, *back[3:]])[0])
    assert list(pair.gaps("named_f1")) == ["demo:0-9#b"]


def test_no_verdict_is_drawn_from_few_sequences():
    """Of two sequences an interval is their range, and leaves out 0 half of the time where nothing is to be found."""
    few = make_report([*many(4), *many(4, dataset="demo:0-3")])  # the same four under another name
    text = few.sections[0].parts[0]
    assert "+0.100 named F1 (n = 4)" in text
    assert "That is no verdict: 1 pair of method and regime has fewer than 5 independent sequences" in text
    enough = make_report(many(5))
    (text,) = [part for part in enough.sections[0].parts if isinstance(part, str)]
    assert "+0.100 [+0.100, +0.100] named F1 (n = 5)" in text
    verdict = "Of 1 pair of method and regime the interval lies above 0 in 1, below in 0, and holds 0 in 0."
    assert verdict in text
    both = make_report([*many(5), *(one | {"regime": "high", "key": f"h{one['key']}"} for one in many(2))])
    left_out = "; 1 more have fewer than 5 independent sequences and are not counted."
    assert left_out in both.sections[0].parts[0]


def test_brackets_and_bold_are_of_enough_sequences():
    """What is printed bold is believed."""
    for count, shown in ((4, False), (5, True)):
        (setting,) = settings(many(count))
        (cell,) = column(differences_table(setting, list(pairs(setting))), "Δ named F1")
        assert (bool(cell.under), cell.strong) == (shown, shown)
        assert bool(column(named_table(setting), "named F1")[0].under) is shown
        one = EqualQuality(Arm("low", "M5", "jpeg"), "M0", (1.5,) * count, 0)
        assert column(equal_table(setting, [one], column="named_f1"), "bits needed")[0].strong is shown


def test_a_figure_of_fewer_sequences_says_so():
    """A method that finds nothing in the hard sequence has no top-1 there, and the highest mean of all."""
    rows = many(6)
    for one in rows:
        one["top1"] = 0.9 if one["sequence"] in "abcde" or one["method"] == "M0" else None
    (setting,) = settings(rows)
    assert column(named_table(setting), "top-1")[0].under == "[0.900, 0.900] n = 5"
    (cell,) = column(differences_table(setting, list(pairs(setting))), "Δ top-1")
    assert cell.under == "[0.000, 0.000] n = 5"


def test_a_line_of_utility_is_of_the_same_sequences_all_along():
    """The hard sequence in the thin regime alone would look as if more bits had helped."""
    rows = [row("easy", "M0", 300_000, 0.8, regime="thin", budget_bps=300_000)]
    rows += [row("hard", "M0", 310_000, 0.2, regime="thin", budget_bps=300_000)]
    rows += [row("easy", "M0", 800_000, 0.8), row("hard", "M5", 300_000, 0.2, regime="thin")]
    rows += [row("easy", "M5", 800_000, 0.9)]
    (setting,) = settings(rows)
    figure = utility_figure(setting, name="utility-1")
    assert "M0 (n = 1)" in figure.svg
    assert "M5 jpeg (n differs)" in figure.svg
    (whole,) = settings([*rows[:3], row("hard", "M0", 800_000, 0.2)])
    assert "(n" not in utility_figure(whole, name="utility-1").svg


def test_waits_are_medians_and_those_that_never_end_are_told():
    """One sequence where half of the tracks are never named right makes a mean infinite, and says nothing."""
    waits = {"a": (0.5, 0.0), "b": (0.7, 0.1), "c": (math.inf, 0.8)}
    rows = [
        row(name, "M0", 1, 0.5, first_correct_p50_s=wait, first_correct_never=never)
        for name, (wait, never) in waits.items()
    ]
    (setting,) = settings(rows)
    table = named_table(setting)
    assert column(table, "first right p50, s")[0].text == "0.70"
    assert column(table, "never right")[0].text == "0.300"
    assert "median over sequences" in table.caption


def test_every_share_of_the_bits_and_every_size_has_a_column():
    """Of DDS a twentieth of the bits stood nowhere, and small objects that were missed cost nothing."""
    sizes = {f"top1_all_{size}": 0.5 for size in ("small", "medium", "large")}
    small = {"small_change_rate": 0.25, "small_pairs": 3, "confidence_gain": 0.1, "proxy_pairs": 9}
    rows = [row("a", "M5", 1, 0.5, other_bps=15_600, macro_f1_all=0.4, **sizes, **small)]
    (setting,) = settings(rows)
    proxies = proxy_table(setting)
    for table, head, shown in (
        *((spent_table(setting), "other, kbps", "15.6"), (named_table(setting), "macro-F1 of all", "0.400")),
        *((size_table(setting), "found & named small", "0.500"), (proxies, "changed small", "0.250")),
        *((proxies, "pairs small", "3.0"), (proxies, "pairs", "9.0")),
    ):
        assert column(table, head)[0].text == shown


def test_pages_in_the_pilots_accounting_say_so_everywhere():
    """Rates by the clip beside the words "processed span" are taken for ours, and are a third of them."""
    rows = [
        row("a", "M5", 800_000, 0.5, clip_s=20.0, other_bps=4000),
        row("a", "M0", 700_000, 0.4, clip_s=20.0),
        row("b", "M0", None, clip_s=20.0, **to_m5(target_bps=800_000, failed="spends 9 bps", matched=False)),
    ]
    pilot = in_accounting(rows, "pilot")
    assert (pilot[0]["other_bps"], pilot[2]["target_bps"]) == (2000, 400_000)
    report = make_report(pilot)
    assert "over the length of the whole clip, unless a table says otherwise" in report.lead[0]
    says = {cells[2].text: cells[3].text for cells in metrics_table("pilot").rows}
    assert says["total_bps"] == "line bytes of everything x 8 / length of the whole clip"
    (setting,) = settings(pilot)
    figure = utility_figure(setting, name="utility-1")
    assert ">400<" in figure.svg  # the budget of 800 kbps, where the points are
    assert ">800<" not in figure.svg
    assert "by the whole clip" in figure.svg
    assert "over the processed span" in failed_table(pilot).caption
    assert "processed span" not in failed_table(rows).caption
    assert "over the processed span, unless" in make_report(rows).lead[0]
    # A refused run without its times: its target would stand in a table as if it had been divided.
    lost = row("a", "M0", None, duration_s=None, **to_m5(target_bps=800_000, failed="no", matched=False))
    (back,) = in_accounting([lost], "pilot")
    assert (back["accounting"], back["target_bps"]) == ("pilot", None)


def test_the_flight_that_is_shown_sent_stills():
    """A comparison of crops without a crop: the median sequence of M6 sent none, and M5 hundreds."""
    rows = [
        {**one, "stills": 5 if one["sequence"] in "ac" and one["method"] == "M5" else 0} for one in study()
    ]
    choice = choose_run(rows)
    assert choice.key == "a-M5-600000"  # b has the median gain, and nothing to show
    assert "of its 2 sequences with stills the one with the median gain" in choice.rule
    none = choose_run([{**one, "stills": 0} for one in study()])
    assert none.key == "b-M5-600000"
    assert "no run sent a still" in none.rule
    silent = choose_run([row("a", "M5", 1, stills=3), row("b", "M5", 1, stills=3)])
    assert "in the middle by name" in silent.rule


def crops(*, gain_db, stills):
    pixels = np.arange(25 * 66 * 3, dtype=np.uint32).reshape(25, 66, 3).astype(np.uint8)
    png = cv2.imencode(".png", pixels)[1].tobytes()
    crop = CropExample(50, gain_db, 28.0, 0.4, 7, "car", "awning-tricycle", 1234, png, png, png)
    told = Timeline(1, (1.0,), (1.0,), (1.0,), (0.5,), (0.5,), (0.5,), (), 0)
    return pixels, crop_pictures(Example("k", "", "by rule", "demo-0", stills, (crop,), told))


def test_crops_are_large_enough_for_print_and_no_pixel_is_thought_up():
    """A crop of 66 pixels is a thumbnail of 5 mm, and a reader that enlarges it smooths what is to be compared."""
    pixels, shown = crops(gain_db=-1.5, stills=1)
    large = cv2.imdecode(np.frombuffer(shown.rows[0].pictures[0].png, np.uint8), cv2.IMREAD_COLOR)
    assert large.shape == (150, 396, 3)
    assert (large[3::6, 3::6] == pixels).all()
    assert (large == large[3::6, 3::6].repeat(6, 0).repeat(6, 1)).all()
    # Names of classes have hyphens; of one still there is no tenth percentile.
    assert "\N{MINUS SIGN}1.5 dB" in shown.rows[0].label
    assert "awning-tricycle" in shown.rows[0].label
    assert "its only still" in shown.caption
    _, several = crops(gain_db=-1.5, stills=2)
    assert "of its 2 stills those at the 50th percentile" in several.caption


@pytest.mark.parametrize(
    "text",
    [
        *("", "foo,bar\n", "policy,selected,ratio,frame_coverage\n"),
        *("foo,bar\n1,2\n", "policy,selected\nall,many\n"),
    ],
)
def test_a_sweep_without_its_columns_or_rows_gets_one_sentence(tmp_path, text):
    """An empty table in a report says that no selector keeps anything."""
    path = tmp_path / "sweep.csv"
    assert sweep_table(path) is None
    path.write_text(text)
    with pytest.raises(UserError, match=r"sweep\.csv is not a table of policy,selected"):
        sweep_table(path)


def test_no_mark_of_a_method_can_be_taken_for_an_arrow_or_another_method():
    """An arrow to the left says that video shows more: a triangle to the left beside it says the same."""
    looks = [style_of(name) for name in METHODS]
    assert not {look.marker for look in looks} & {"<", ">"}
    assert len({(look.colour, look.marker) for look in looks}) == len(looks)
    assert style_of("DDS").colour == PALETTE["sky"]


def test_a_figure_is_of_one_regime():
    """Two regimes of all methods and codecs are longer than a page."""
    rows = [*many(5), *(one | {"regime": "high: 1", "key": f"h{one['key']}"} for one in many(5))]
    (setting,) = settings(rows)
    figures = difference_figures(setting, list(pairs(setting)), name="answer", column="named_f1")
    assert [one.name for one in figures] == ["answer-high-1", "answer-low"]


def test_codecs_are_shown_over_the_bytes_of_their_stills():
    """Which codec is worth its bytes is the question; a row of names does not say how many they are."""
    rows = [row("a", "M5", 1, 0.5, mean_still_bytes=400.0), row("a", "M5", 2, 0.6, still_codec="avif")]
    (setting,) = settings([rows[0], {**rows[1], "mean_still_bytes": 150.0}])
    figure = codec_figure(setting, name="codecs-1")
    assert "bytes/still" in figure.svg
    assert "M5 avif" in figure.svg
    (bare,) = settings([{**one, "mean_still_bytes": None} for one in rows])
    assert codec_figure(bare, name="codecs-1") is None
    sizes = zip(rows, (3000.0, 3300.0), strict=True)
    (alike,) = settings([{**one, "mean_still_bytes": size} for one, size in sizes])
    figure = codec_figure(alike, name="codecs-1")
    assert len(set(re.findall(r">(3\d\d\d)<", figure.svg))) > 1, "one mark alone tells no scale"


def test_marks_of_an_axis_do_not_touch():
    """Those of 1.25 and 1.6 were one number; of many budgets none could be read."""
    axes = Figure(figsize=(7.2, 2)).subplots(1, 4)[0]
    axes.set_xscale("log")
    axes.set_xlim(0.1, 10)
    log_axis(axes, (1, 2, 0.5, 5, 0.8, 1.25, 1.6))
    assert sorted(axes.get_xticks()) == [1, 5]
    axes.set_xlim(215, 305)
    rate_axis(axes, (300,))  # of a study at one budget
    assert [label.get_text() for label in axes.get_xticklabels()] == ["300", "240", "270"]


def test_figures_of_an_earlier_report_go_and_what_is_not_ours_stays(tmp_path):
    """A paper that takes in figures/ takes in those of a regime that is no longer there."""
    write_results(many(2), tmp_path / "results.parquet")
    figures = tmp_path / "figures"
    figures.mkdir()
    for name in ("utility-9.svg", "answer-moderate.pdf", "crop-10-base.png", "mine.svg", "answer.txt"):
        (figures / name).write_text("old")
    write_report(tmp_path)
    names = {path.name for path in figures.iterdir()}
    assert names == {"answer.svg", "answer.pdf", "utility-1.svg", "utility-1.pdf", "mine.svg", "answer.txt"}
    svg = (figures / "answer.svg").read_text()
    assert '<rect width="100%" height="100%" fill="#ffffff"/>' in svg, "black on black, otherwise"
    (inline,) = [part for part in make_report(many(2)).sections[0].parts if not isinstance(part, str)]
    assert "#ffffff" not in inline_svg(replace(inline, name="x")).split("</defs>")[0]


def _interval(values):
    return interval_of({f"demo:0-99#demo-{seed}": value for seed, value in enumerate(values)})


def test_an_interval_worked_out_by_hand():
    """A wrong interval would call noise a finding; one that changes from run to run proves nothing."""
    # The number of ones among five drawn from 0 0 0 0 1 is binomial (5, 0.2): its distribution function is
    # 0.328 at 0, 0.942 at 2 and 0.993 at 3, so that 95 % of the means lie from 0 to 3/5.
    found = _interval([0.0, 0.0, 1.0, 0.0, 0.0])
    assert (found.mean, found.low, found.high, found.sequences) == (0.2, 0.0, pytest.approx(0.6), 5)
    values = np.random.default_rng(3).exponential(size=24).tolist()
    first = _interval(values)
    assert _interval([*values, math.nan]) == first
    assert first.low < first.mean < first.high


def test_the_interval_holds_the_true_mean_about_as_often_as_it_says():
    """Sequences of a mean of 1: of 95 % intervals of thirty of them some 93 % hold it."""
    rng = np.random.default_rng(0)
    intervals = [_interval(rng.normal(1, 0.3, 30).tolist()) for _ in range(100)]
    assert 87 <= sum(one.low <= 1 <= one.high for one in intervals) <= 99


def test_few_no_and_endless_values():
    """Few sequences have a mean and no interval; equal ones one of no width; none nothing; an endless wait no end."""
    few = _interval([0.4, math.nan] * (ENOUGH - 1))
    assert (few.mean, few.sequences) == (0.4, ENOUGH - 1)
    endless = _interval([1.0, math.inf, 2.0, 3.0, 4.0])
    assert endless.mean == math.inf
    assert np.isnan([few.low, few.high, endless.low]).all()
    assert _interval([]).sequences == 0
    assert np.isnan([_interval([math.nan]).mean, mean_of([math.inf, -math.inf]).mean]).all()
    equal = _interval([0.3] * 5)
    assert (equal.low, equal.high) == (pytest.approx(0.3), pytest.approx(0.3))


@pytest.mark.parametrize(
    "names",
    [
        lambda p: [f"still:air?seeds=0-2&view=0.6#{p}-{seed}" for seed in range(3)],
        lambda p: [f"demo:0-4#demo-{p}", f"demo:0-9,codes#demo-{p}-codes", f"demo:0-4,4k#demo-{p}-4k"],
        lambda p: [f"mot:flights{rate}#{p}" for rate in ("", "?fps=15", "?fps=30")],
    ],
)
def test_seeds_over_one_picture_are_no_sequences_of_their_own(names):
    """Ten flights over two pictures had an interval as of ten pictures, and made a verdict."""
    figures = [0.1, 0.4, 0.2, 0.8, 0.3]

    def found(pictures):
        return interval_of({name: figures[p] for p in range(pictures) for name in names(p)})

    assert math.isnan(found(4).low)
    assert found(4).sequences == 12
    once, often = _interval(figures), found(5)
    assert (often.low, often.high) == (pytest.approx(once.low), pytest.approx(once.high))

"""Runs side by side: what is read, the statistics, the pages."""

import csv
import re
import statistics
from html.parser import HTMLParser
from pathlib import Path

import pytest

from occfusion.__main__ import main
from occfusion.compare.figures import seconds_to_reach, summarise_scenes, summarise_seeds, targets
from occfusion.compare.grid import picture_grid
from occfusion.compare.methods import method_settings, methods
from occfusion.compare.reading import CurvePoint, find_runs, read_run, read_runs
from occfusion.compare.tables import latex_table, summary_grid
from run_folders import write_run


def points(*pairs: tuple[float, float | None]) -> list[CurvePoint]:
    return [CurvePoint(x, {"psnr": y}) for x, y in pairs]


def test_time_to_a_target_is_linear_between_measurements() -> None:
    curve = points((0, 10.0), (10, None), (20, 20.0), (40, 19.0), (80, 30.0))
    assert seconds_to_reach(curve, 15.0) == pytest.approx(10.0)
    assert seconds_to_reach(curve, 20.0) == pytest.approx(20.0)
    assert seconds_to_reach(curve, 25.0) == pytest.approx(40 + 40 * 6 / 11)
    assert seconds_to_reach(curve, 5.0) == 0.0
    assert seconds_to_reach(curve, 31.0) is None
    assert seconds_to_reach([], 1.0) is None


def test_curve_counts_the_stages_before(tmp_path: Path) -> None:
    run = read_run(write_run(tmp_path / "B", variant="B", init_seconds=7.0))
    assert [p.seconds for p in run.curve] == [7.0, 17.0, 37.0]


def test_seeds_and_scenes_are_kept_apart(tmp_path: Path) -> None:
    figures = {"s1": ([20.0, 22.0, 24.0], 10), "s2": ([30.0, 31.0, 32.0], 30)}
    for scene, (values, images) in figures.items():
        for seed, value in enumerate(values):
            write_run(tmp_path / scene / str(seed), scene=scene, seed=seed, psnr=value, images=images)
    runs, faults = read_runs(find_runs([tmp_path]))
    assert not faults and len(runs) == 6
    by_scene = {s.scene: s.values["full.psnr"] for s in summarise_seeds(runs)}
    for scene, (values, _) in figures.items():
        assert by_scene[scene].mean == pytest.approx(statistics.mean(values))
        assert by_scene[scene].deviation == pytest.approx(statistics.stdev(values))
        assert by_scene[scene].count == 3
    scenes, images_ = summarise_scenes(runs)
    assert (scenes.level, scenes.seeds, scenes.scenes) == ("scenes", 3, 2)
    assert scenes.values["full.psnr"].mean == pytest.approx(26.5)
    assert scenes.values["full.psnr"].deviation == pytest.approx(statistics.stdev([22.0, 31.0]))
    assert scenes.seed_deviation["full.psnr"] == pytest.approx(((2**2 + 1**2) / 2) ** 0.5)
    assert images_.values["full.psnr"].mean == pytest.approx((22 * 10 + 31 * 30) / 40)
    assert images_.values["full.psnr"].deviation is None


def test_time_to_the_error_of_variant_a(tmp_path: Path) -> None:
    write_run(tmp_path / "A", curve=((0, 15.0), (30, 24.0)))
    write_run(tmp_path / "B", variant="B", curve=((0, 15.0), (10, 25.0)), init_seconds=5.0)
    write_run(tmp_path / "G", variant="gauhuman", curve=((0, 15.0), (90, 20.0)))
    runs, _ = read_runs(find_runs([tmp_path]))
    assert [run.variant for run in runs] == ["gauhuman", "A", "B"]
    times = [s.values.get("seconds_to_target") for s in summarise_seeds(runs)]
    assert [t and t.mean for t in times] == [None, pytest.approx(30.0), pytest.approx(5 + 9.0)]


def test_methods_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    write_run(tmp_path / "a", optim={"steps": 100})
    write_run(tmp_path / "b", optim={"steps": 100}, seed=1)
    write_run(tmp_path / "c", optim={"steps": 300})
    write_run(tmp_path / "d", variant="B", optim={"steps": 300})
    runs, _ = read_runs(find_runs([tmp_path]))
    named = {run.folder.name: name for run, name in zip(runs, methods(runs), strict=True)}
    assert named == {"a": "A optim.steps=100", "b": "A optim.steps=100", "c": "A optim.steps=300", "d": "B"}
    write_run(tmp_path / "e", optim={"steps": 1, "rate": 2, "x": {"y": 3}})
    runs, _ = read_runs(find_runs([tmp_path]))
    assert sorted(set(methods(runs))) == ["A #1", "A #2", "A #3", "B"]
    assert method_settings(runs)["A #3"] == "optim.rate=2 optim.steps=1 optim.x.y=3"


def test_a_preset_stands_for_what_it_sets(tmp_path: Path) -> None:
    fast = {"speed": {"name": "fast"}, "optim": {"steps": 1, "rate": 2, "x": 3}}
    write_run(tmp_path / "a", optim={"steps": 100, "rate": 1, "x": 1}, speed={"name": "default"})
    write_run(tmp_path / "b", **fast)
    runs, _ = read_runs(find_runs([tmp_path]))
    assert sorted(methods(runs)) == ["A speed=default", "A speed=fast"]
    write_run(tmp_path / "c", **{**fast, "optim": {"steps": 2, "rate": 2, "x": 3}})
    runs, _ = read_runs(find_runs([tmp_path]))
    assert "A optim.steps=2 speed=fast" in methods(runs)


def test_recipes_are_methods_of_their_own(tmp_path: Path) -> None:
    paper = {"recipe": {"name": "paper"}, "optim": {"steps": 1, "rate": 2, "x": 3}}
    write_run(tmp_path / "a", optim={"steps": 100, "rate": 1, "x": 1}, recipe={"name": "ours"})
    write_run(tmp_path / "b", **paper)
    write_run(tmp_path / "c", seed=1, **paper)
    runs, _ = read_runs(find_runs([tmp_path]))
    assert sorted(methods(runs)) == ["A recipe=ours", "A recipe=paper", "A recipe=paper"]
    assert {key[2] for key in targets(runs)} == {
        "ours",
        "paper",
    }  # each recipe has an `A` of its own to be reached
    assert sorted(s.seeds for s in summarise_seeds(runs)) == [1, 2]


def test_perceptual_metrics_get_columns_of_their_own(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    write_run(tmp_path / "b", metric="LPIPS (VGG, inputs 0..1)", variant="B")
    runs, _ = read_runs(find_runs([tmp_path]))
    names = ["LPIPS (VGG, inputs 0..1)", "ST-LPIPS (VGG)"]
    header, rows = summary_grid(summarise_seeds(runs), names)
    columns = [header.index(f"{name} x1000") for name in names]
    assert [[row[k] for k in columns] for row in rows] == [["-", "50.0"], ["50.0", "-"]]


@pytest.mark.parametrize(
    ("file", "content", "message"),
    [
        ("metrics.json", None, "unfinished"),
        ("metrics.json", "{", "damaged"),
        ("metrics.json", "[]", "lacks dataset"),
        ("plan.json", None, "plan.json is damaged"),
        ("plan.json", '{"decisions": [{"part": 1}]}', "lacks"),
        ("config.yaml", "a: [", "config.yaml is damaged"),
        ("config.yaml", "- 1", "no settings"),
        ("error_vs_time.csv", "stage,step\noptim,1\n", "error_vs_time.csv is damaged"),
        ("error_vs_time.csv", "stage,train_seconds,psnr,ssim,lpips,mask_iou\noptim,1,nan,1,1,1\n", "finite"),
    ],
)
def test_damaged_folders_are_named_and_the_others_reported(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], file: str, content: str | None, message: str
) -> None:
    good, bad = write_run(tmp_path / "good"), write_run(tmp_path / "bad")
    (bad / file).unlink() if content is None else (bad / file).write_text(content)
    assert main(["report", str(good), str(bad), "--output", str(tmp_path / "out")]) == 1
    assert message in capsys.readouterr().err
    page, text = ((tmp_path / "out" / name).read_text() for name in ("report.html", "report.md"))
    assert "Comparison of 1 runs" in page and str(bad) in page and str(bad) in text


def test_no_run_at_all(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["report", str(tmp_path), "--output", str(tmp_path / "out")]) == 1
    assert "not a run folder" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


class Page(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.addresses: list[str] = []
        self.tags: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [v or "" for k, v in attrs if k in ("src", "href", "xlink:href")]


def test_the_page_holds_everything_it_shows(tmp_path: Path) -> None:
    for variant in ("gauhuman", "A"):
        write_run(tmp_path / "runs" / variant, variant=variant)
    assert main(["report", str(tmp_path / "runs"), "--output", str(tmp_path / "out")]) == 0
    text = (tmp_path / "out" / "report.html").read_text()
    page = Page()
    page.feed(text)
    assert page.addresses and all(a.startswith(("data:image/png;base64,", "#")) for a in page.addresses)
    assert not {"script", "link", "iframe"} & set(page.tags)
    assert not re.search(r"url\((?!#)", text) and "@import" not in text
    assert page.tags.count("svg") == 1 and page.tags.count("img") == 2 * 6
    assert "&lt;does&gt;" in text and "<does>" not in text
    markdown = (tmp_path / "out" / "report.md").read_text()
    links = re.findall(r"!\[.*?\]\((.*?)\)", markdown)
    assert links and all((tmp_path / "out" / link).stat().st_size > 100 for link in links)


def test_pictures_are_of_the_same_views_and_cut_alike(tmp_path: Path) -> None:
    from run_folders import write_pictures

    a, b = write_run(tmp_path / "a"), write_run(tmp_path / "b", variant="B")
    write_pictures(b, level=90, views=("c2/000004", "c9/000001"))
    runs, _ = read_runs([a, b])
    rows, remarks = picture_grid(runs, ["A", "B"])
    assert not remarks
    (row,) = rows
    assert row.view == "c2/000004"
    assert [title for title, _ in row.cells] == ["input", "A", "B", "truth", "error of A", "error of B"]
    assert {image.shape for _, image in row.cells} == {(18 + 16, 10 + 16, 3)}
    assert [int(image.max()) for _, image in row.cells] == [200, 60, 90, 200, 60, 90]


def test_a_run_without_described_pictures_is_named(tmp_path: Path) -> None:
    a, b = write_run(tmp_path / "a"), write_run(tmp_path / "b", variant="B")
    (b / "pictures" / "held_out.json").unlink()
    rows, (remark,) = picture_grid(read_runs([a, b])[0], ["A", "B"])
    assert len(rows) == 2 and "evaluation.again=true" in remark
    (b / "pictures" / "held_out.json").write_text(
        '{"views": [{"name": 1, "parts": {"input": [0, 0, 999, 1]}}]}'
    )
    _, (remark,) = picture_grid(read_runs([a, b])[0], ["A", "B"])
    assert "outside the picture" in remark


def test_tables_set_the_paper_apart(tmp_path: Path) -> None:
    write_run(tmp_path / "a")
    runs, _ = read_runs([tmp_path / "a"])
    grid = summary_grid(summarise_seeds(runs), ["ST-LPIPS (VGG)"])
    tex = latex_table(grid, "100 % & _more_")
    assert "||rrrr}" in tex and r"100 \% \& \_more\_" in tex and tex.count(r"\\") == 2
    main(["report", str(tmp_path / "a"), "--output", str(tmp_path / "out")])
    with (tmp_path / "out" / "summary.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["level"] for row in rows] == ["scenes", "images", "seeds"]
    assert float(rows[0]["paper.psnr"]) == 22.54 and float(rows[0]["full.psnr.mean"]) == 25.0
    assert rows[0]["full.psnr.deviation"] == ""

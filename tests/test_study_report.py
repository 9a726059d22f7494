"""The study's report, captions, figures and page, from results that are written by hand."""

import base64
import json
from pathlib import Path

import numpy as np
import pytest
from handwritten_study import finished, results

from rt_torchrl.study import captions, report
from rt_torchrl.study import figures as charts
from rt_torchrl.study.report import CaptionedFigure
from rt_torchrl.study.results import Results
from rt_torchrl.study.tables import paper_table


def test_the_report_says_what_was_found(tmp_path):
    figures = [CaptionedFigure(Path("figures/a.png"), "what is seen")]
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"PNG")
    source, _ = report.write(tmp_path, results(tmp_path), figures=figures, quick=True, command="uv run x")
    text = source.read_text()
    assert "Within 5 % of the oracle: **yes** (1.020)" in text
    assert "Against model free alone: **better**" in text
    assert "Against model based alone: **neither better nor worse**" in text
    assert "Twinning against the classical PD: **better**" in text
    assert "Twinning, other against the classical PD: **worse**" in text
    assert "(4.18 ± 0.01)e-1" in text and "no result" in text and "uv run x" in text
    assert "![what is seen](figures/a.png)\n\n*what is seen*" in text
    (row,) = [line for line in text.splitlines() if line.startswith("| noise 1 % | twinning |")]
    assert "| 1.500 |" in row
    assert any(line.startswith("| model error | PD |") and "| 1.000 |" in line for line in text.splitlines())
    assert "Twinning, noise 1 %: against model based alone **neither better nor worse**" in text
    assert "against model free alone **better**" in text
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["entries"]["PD"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)
    assert numbers["variants"]["noise 1 %"]["twinning"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)


def test_the_table_has_the_limit_and_predictive_control_on_the_first_episodes(tmp_path):
    found = results(tmp_path)
    text = report.write(tmp_path, found, figures=[], quick=False, command="x")[0].read_text()
    rows = {line.split(" | ")[0][2:]: line.split(" | ") for line in text.splitlines() if line.startswith("| ")}
    entries = {entry.name: entry for entry in found.entries["flapping_wing"]}
    best = 0.5 * entries["twinning"].costs[0, :8].mean()
    assert rows["limit"][4] == "1.000" and rows["mpc"][4] == "1.500"
    assert rows["twinning"][4] == f"{entries['twinning'].costs[:, :8].mean() / best:.3f}"
    assert rows["mpc"][3] == f"{1.5 * best / entries['oracle'].costs[:, :8].mean():.3f}"
    assert "first\n8 of the unseen episodes" in text and "3.25 ms in the median" in text
    assert "against the classical limit" not in text and "against the classical mpc" not in text
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["limits"]["mpc"]["milliseconds"] == 3.25 and numbers["limits"]["limit"]["episodes"] == 8
    without = report.write(tmp_path, found._replace(limits={"flapping_wing": []}), figures=[], quick=False, command="x")
    assert "limit" not in without[0].read_text()


def test_the_figures_show_every_arm_and_yardstick(tmp_path):
    found = results(tmp_path)
    curves = charts.learning(found.entries)
    texts = {text.get_text() for text in curves.legends[0].get_texts()}
    assert texts == {"twinning", "model free", "model based", "twinning, other", "oracle", "classical"}
    (line,) = [line for line in curves.axes[0].lines if line.get_label() == "twinning"]
    assert np.allclose(line.get_ydata(), [5.0, 1.05, 1.0])
    other = {"a": [found.entries["flapping_wing"][3]], "b": found.entries["flapping_wing"][::-1]}
    drawn = [ax.lines for ax in charts.learning(other).axes]
    colours = [{line.get_color() for line in lines if line.get_label() == "twinning, other"} for lines in drawn]
    assert colours[0] == colours[1] and len(colours[0]) == 1
    violins = charts.robustness(found.entries)
    labels = [label.get_text() for label in violins.axes[0].get_xticklabels()]
    assert labels == ["twinning", "model free", "model based", "twinning,\nother", "PD", "oracle"]
    harder = charts.variants(found.entries, found.variants).axes[0]
    assert [label.get_text() for label in harder.get_xticklabels()] == ["nominal", "noise 1 %", "model error"]
    points = [line for line in harder.lines if np.allclose(line.get_xdata(), 0.8)]
    assert np.allclose([line.get_ydata() for line in points], 1.5, rtol=0.05) and len(points) == 1
    line = {"name": "K_P", "unit": "-", "values": [1.0, 10.0], "costs": [2.0, 1.0]}
    (axes,) = charts.cost_line(line, found.entries["flapping_wing"]).axes
    assert [drawn.get_label() for drawn in axes.lines[1:]] == ["twinning", "PD", "oracle"]
    assert np.allclose(axes.lines[1].get_ydata(), found.entries["flapping_wing"][0].mean)
    following = charts.following(found.entries, found.variants).axes[0]
    assert [line.get_label() for line in following.lines] == ["nominal", "model error"]
    assert np.allclose(following.lines[1].get_ydata(), [0.05, 0.0105, 0.01])


def test_a_figure_shows_how_far_from_the_limit_everything_is(tmp_path):
    found = results(tmp_path)
    (ax,) = charts.limits(found.entries, found.limits).axes
    drawn = dict(zip([label.get_text() for label in ax.get_yticklabels()], ax.patches, strict=True))
    twinning, best = found.entries["flapping_wing"][0], found.limits["flapping_wing"][0]
    assert drawn["mpc"].get_width() == pytest.approx(1.5) and "limit" not in drawn
    assert drawn["twinning"].get_width() == pytest.approx(twinning.costs[:, :8].mean() / best.costs.mean())
    assert set(drawn) == {"mpc", *(entry.name.replace("_", " ") for entry in found.entries["flapping_wing"])}
    said = captions.limits(found)
    assert f"the limit is {best.mean:.4g}; mpc is nearest, 1.500" in said


def test_captions_say_what_is_seen(tmp_path):
    found = results(tmp_path)
    curves = captions.learning(found)
    assert "twinning 3, 3; model based 3, 3; model free never, never." in curves
    worst = max(e.costs.max() for e in found.entries["flapping_wing"] if e.name == "PD")
    assert f"PD {worst:.3g}" in captions.robustness(found)
    assert "twinning suffers most from noise 1 %, 1.5 times its nominal cost" in captions.variants(found)
    assert "J_p ends at 0.01, with model error at 0.01" in captions.following(found)
    line = {"name": "K_P", "values": [1.0, 10.0, 1e3, 1e4], "costs": [2.5, 2.3, 2.4, 2.2]}
    said = captions.gain_line(line)
    assert "K_P = 10 with 2.3, 2.4 at K_P = 1e+03, and 2.2 at K_P = 1e+04" in said
    assert "2.5 on 1, 2.3 on 10" in captions.episode_line(line | {"values": [1, 10, 100, 1000]})
    assert "falls all the way" in captions.gain_line(line | {"costs": [4.0, 3.0, 2.0, 1.0]})


def test_captions_of_a_training_come_from_its_metrics(tmp_path):
    metrics = finished(tmp_path, 0, 0.0).metrics()
    found = captions.of_run("flapping_wing", metrics)
    assert found["learning_curves"].endswith("Swap after episode 2; no clone. J_a of the live policy went from 5 to 1.")
    # The model-free costs are twice the live ones.
    assert "The live policy (model based) costs less than model free on 30 of 30." in found["unseen"]
    assert "The RMS error along the last episode is 0.1, 0.02; that of the initial twin is 1, 0.2." in found["polars"]
    assert "RMS error" not in found["flight"]


def test_captions_and_tables_have_words_for_what_diverges(tmp_path):
    """``metrics.json`` holds null for it."""
    metrics = finished(tmp_path, 0, 0.0).metrics()
    unseen = metrics["summary"]["unseen"]
    metrics["episodes"][0]["J_a_unseen"] = unseen["J_a_model_free"]["mean"] = unseen["costs"]["model_free"][0] = None
    found = captions.of_run("flapping_wing", metrics)
    assert found["learning_curves"].endswith("J_a of the live policy went from infinity to 1.")
    assert "costs less than model free on 30 of 30." in found["unseen"]
    assert "| inf |" in paper_table({"flapping_wing": [metrics["summary"]]})


def test_the_page_holds_its_figures(tmp_path):
    (tmp_path / "figures").mkdir()
    (tmp_path / "figures" / "a.png").write_bytes(b"\x89PNG")
    figures = [CaptionedFigure(Path("figures/a.png"), "what is seen")]
    _, html = report.write(tmp_path, results(tmp_path), figures=figures, quick=False, command="uv run x")
    text = html.read_text()
    held = base64.b64encode(b"\x89PNG").decode()
    assert "<table>" in text and f'src="data:image/png;base64,{held}"' in text
    assert "figures/a.png" not in text and "no result" not in text
    assert text.count("<h3>") == 1 and text.count("<li>") == 5 + 2


def test_a_study_without_variants_has_no_section_of_them(tmp_path):
    found = results(tmp_path)
    alone = Results(found.entries, found.summaries, {"flapping_wing": {}}, {"flapping_wing": []})
    source, _ = report.write(tmp_path, alone, figures=[], quick=False, command="uv run x")
    assert "Sensor noise and model error" not in source.read_text()

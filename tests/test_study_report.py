"""The study's tables, figures and numbers, from results that are written by hand."""

import json
from pathlib import Path

import numpy as np
import pytest
from handwritten_study import finished, results

from rt_torchrl.study import figures as charts
from rt_torchrl.study import page
from rt_torchrl.study.tables import difference_table, paper_table


def rows_of(text):
    """Cells of each row of the Markdown tables in a text."""
    return [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if line[:2] == "| "]


def test_the_page_has_tables_and_numbers(tmp_path):
    figures = [Path("figures/a.png")]
    source = page.write(tmp_path, results(tmp_path), figures=figures, quick=True, command="uv run x")
    text = source.read_text()
    assert "(4.18 ± 0.01)e-1" in text and "no result" in text and "uv run x" in text and "![a](figures/a.png)" in text
    harder = {tuple(row[:2]): row for row in rows_of(text)}
    assert harder["noise 1 %", "twinning"][4] == "1.500" and harder["model error", "PD"][4] == "1.000"
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["entries"]["PD"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)
    assert numbers["variants"]["noise 1 %"]["twinning"]["J_a"] == pytest.approx(1.5 * 1.0, rel=0.1)


def test_differences_say_who_is_better(tmp_path):
    found = results(tmp_path)
    rows = rows_of(difference_table({"nominal": found.entries["flapping_wing"]} | found.variants["flapping_wing"]))
    signs = {}
    for variant, arm, other, interval in rows[2:]:
        low, high = map(float, interval.split(" … "))
        signs[variant, arm, other] = -1 if high < 0.0 else 1 if low > 0.0 else 0
    assert signs["nominal", "twinning", "model free"] == -1 and signs["nominal", "twinning", "model based"] == 0
    assert signs["nominal", "twinning", "PD"] == -1 and signs["nominal", "twinning, other", "PD"] == 1
    assert signs["noise 1 %", "twinning", "model free"] == -1 and signs["noise 1 %", "twinning", "model based"] == 0
    assert not any("oracle" in key for key in signs)


def test_the_table_has_the_limit_and_predictive_control_on_the_first_episodes(tmp_path):
    found = results(tmp_path)
    text = page.write(tmp_path, found, figures=[], quick=False, command="x").read_text()
    rows = {row[0]: row for row in reversed(rows_of(text))}
    entries = {entry.name: entry for entry in found.entries["flapping_wing"]}
    best = 0.5 * entries["twinning"].costs[0, :8].mean()
    assert rows["limit"][4] == "1.000" and rows["mpc"][4] == "1.500"
    assert rows["twinning"][4] == f"{entries['twinning'].costs[:, :8].mean() / best:.3f}"
    assert rows["mpc"][3] == f"{1.5 * best / entries['oracle'].costs[:, :8].mean():.3f}"
    assert "on the first 8 unseen episodes" in text and "3.25 ms in the median" in text
    numbers = json.loads((tmp_path / "study.json").read_text())["flapping_wing"]
    assert numbers["limits"]["mpc"]["milliseconds"] == 3.25 and numbers["limits"]["limit"]["episodes"] == 8
    without = page.write(tmp_path, found._replace(limits={"flapping_wing": []}), figures=[], quick=False, command="x")
    assert "limit" not in without.read_text()


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


def test_tables_have_a_word_for_what_diverges(tmp_path):
    """``metrics.json`` holds null for it."""
    metrics = finished(tmp_path, 0, 0.0).metrics()
    metrics["summary"]["unseen"]["J_a_model_free"]["mean"] = None
    assert "| inf |" in paper_table({"flapping_wing": [metrics["summary"]]})


def test_a_study_without_variants_has_no_section_of_them(tmp_path):
    found = results(tmp_path)._replace(variants={"flapping_wing": {}}, limits={"flapping_wing": []})
    source = page.write(tmp_path, found, figures=[], quick=False, command="uv run x")
    assert "Sensor noise and model error" not in source.read_text()

"""The page of a finished run, read as text and opened in a browser."""

import re
import shutil
from pathlib import Path

import pytest

pytest.importorskip("plotly", reason="a report needs the extra report")

from markupsafe import escape
from test_export_recipe import recipe

from rt_torchrl import load_run
from rt_torchrl.runs.command_line import load_recipe
from rt_torchrl.runs.report_page import bounds, numbers, story, write_report

SMALL = Path(__file__).with_name("small_recipe.py")
CHROMIUM = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
SIZES = {"desktop": (1280, 900), "phone": (390, 800)}


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report") / "run"
    small = load_recipe(SMALL)
    small.main(small.Config(log_dir=folder, episodes=2, unseen_every=1))
    config = recipe("report").Config(run=folder)
    recipe("report").main(config)
    return folder / "report.html"


def test_it_holds_everything_that_it_shows(page):
    text = page.read_text(encoding="utf-8")
    own = re.sub(r"<script.*?</script>", "", text, flags=re.DOTALL)
    assert not re.findall(r"(?:src|href)\s*=", own) and len(re.findall(r'id="plot-\d+"', own)) == 5
    run = load_run(page.parent)
    for number, about in numbers(run.metrics):
        assert f"<b>{number}</b><span>{escape(about)}</span>" in own
    assert "python" in own and f"Run {page.parent.name}" in own


def episode(k, **entries):
    return {"episode": k, "live": "model_free", "event": "keep", "real_cost": 2.0 - k} | entries


def test_the_story_has_a_sentence_for_each_event():
    told = story(
        {
            "episodes": [
                episode(0, start_cost=3.0, plan_accepted=1.0),
                episode(1, event="swap", plan_accepted=0.0, reason="plan refused: <worse>"),
                episode(2, live="model_based", event="clone", closure_refused=1.0, real_cost=None),
            ]
        }
    )
    assert told == [
        "Before the first episode the policies learned from a flight of cost 3.",
        "Episode 0: the model-free policy acts first and costs 2.",
        "Episode 1: the model-free policy hands over to the other one.",
        "Episode 1: plan refused: <worse>.",
        "Episode 2: the idle policy becomes a copy of the model-based one.",
        "Episode 2: the new closure made the twin diverge and was refused.",
        "1 of 2 plans were better than the policy before and were kept.",
        "The last episode costs not finite, with the model-based policy.",
    ]


def test_bounded_states_have_a_table():
    def merit(outside):
        beyond = {"mean": outside / 10.0}
        return {"speed outside [%]": {"mean": outside}, "speed beyond [m/s]": beyond, "mean power [MW]": {"mean": 4.0}}

    unseen = {
        "merit": {"model_based": merit(0.0), "model_free": merit(5.0)},
        "baselines": {"PI": {"merit": merit(2.0)}},
    }
    assert bounds({"summary": {"unseen": unseen}}) == [
        ["mean over the episodes", "model-based", "model-free", "PI"],
        ["speed outside [%]", "0", "5", "2"],
        ["speed beyond [m/s]", "0", "0.5", "0.2"],
    ]
    free = {"merit": {"model_based": {}, "model_free": {}}, "baselines": {}}
    assert bounds({"summary": {"unseen": free}}) == []


def test_a_run_without_results_has_no_report(page, tmp_path):
    shutil.copytree(page.parent, tmp_path / "run")
    (tmp_path / "run" / "metrics.json").unlink()
    with pytest.raises(ValueError, match="metrics.json cannot be read"):
        write_report(load_run(tmp_path / "run"))


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium on this machine; apt-get install chromium")
def test_a_browser_draws_it_at_both_widths(page):
    playwright = pytest.importorskip("playwright.sync_api", reason="a browser is driven by the group test")
    with playwright.sync_playwright() as driver:
        browser = driver.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
        for width, height in SIZES.values():
            tab = browser.new_page(viewport={"width": width, "height": height})
            wrong, asked = [], []
            tab.on("pageerror", lambda error, wrong=wrong: wrong.append(str(error)))
            tab.on("request", lambda request, asked=asked: asked.append(request.url))
            tab.goto(page.as_uri())
            tab.wait_for_function("document.querySelectorAll('.main-svg').length >= 5")
            assert not wrong and asked == [page.as_uri()]  # no network
            assert tab.evaluate("document.documentElement.scrollWidth") <= width
            boxes = tab.evaluate(
                "[...document.querySelectorAll('.js-plotly-plot')].map(p => p.getBoundingClientRect().width)"
            )
            assert len(boxes) == 5 and all(0.6 * width < box <= width or box > 700 for box in boxes)
            assert tab.evaluate("document.querySelectorAll('.js-plotly-plot path.js-line').length") >= 8
        browser.close()

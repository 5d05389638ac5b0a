"""Sliders draw a picture again when they are moved; without ipywidgets it is drawn once."""

import sys

import matplotlib.pyplot as plt
import pytest
from matplotlib.figure import Figure

from gdptlab import locate, plots


@pytest.fixture(autouse=True)
def nothing_left_open():
    yield
    assert plt.get_fignums() == []


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> list:
    """What is displayed."""
    displayed = []
    monkeypatch.setattr("IPython.display.display", displayed.append)
    return displayed


def test_the_picture_is_drawn_again_when_a_slider_is_moved(shown: list) -> None:
    pytest.importorskip("ipywidgets")
    drawn = []

    def draw(size: int = 2, colour: str = "red") -> Figure:
        drawn.append((size, colour))
        return plt.figure()

    figure = plots.slide(draw, size=(1, 2, 3))
    assert isinstance(figure, Figure) and drawn == [(2, "red")]  # once, although there is a slider
    slider = shown[0].children[0]
    slider.value = 3
    assert drawn == [(2, "red"), (3, "red")]


def test_a_default_must_be_among_the_choices() -> None:
    with pytest.raises(ValueError, match="size"):
        plots.slide(lambda size=5: plt.figure(), size=(1, 2))


def test_without_widgets_the_picture_is_drawn_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "ipywidgets", None)
    figure = plots.slide(plt.figure)
    assert isinstance(figure, Figure)
    plt.close(figure)


def test_panel_shows_what_locate_finds(few, calibration, shown: list) -> None:
    pytest.importorskip("ipywidgets")
    figure = plots.panel(few[0], calibration, threshold=0.8)
    table = locate(few[0], calibration, threshold=0.8)
    assert len(figure.axes[0].collections[0].get_offsets()) == len(table)
    names = [slider.description for slider in shown[0].children[:-1]]
    assert names == ["threshold", "n_sub", "refine", "method"]

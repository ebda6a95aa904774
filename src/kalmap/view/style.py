"""How every figure looks, and how it becomes a PNG. Nothing here touches matplotlib's global state."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's palette: told apart by all common kinds of colour vision.
BLACK, GREY = "#000000", "#7a7a7a"
BLUE, VERMILLION, GREEN = "#0072B2", "#D55E00", "#009E73"
ORANGE, SKY, PURPLE = "#E69F00", "#56B4E9", "#CC79A7"
METHOD_COLOURS = (BLUE, VERMILLION, GREEN, ORANGE, PURPLE, SKY, BLACK, GREY)
# Beyond the colours, and for print in grey, methods differ by their dashes too.
METHOD_LINES: tuple[Any, ...] = ("-", "--", "-.", (0, (1, 1)), (0, (5, 1, 1, 1, 1, 1)))

DPI = 120
WIDTH = 1000 / DPI

_RC: Any = {
    "font.family": "DejaVu Sans",
    "font.size": 9.0,
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9.0,
    "axes.edgecolor": "#555555",
    "axes.linewidth": 0.7,
    "axes.grid": True,
    "axes.axisbelow": True,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "grid.color": "#dddddd",
    "grid.linewidth": 0.6,
    "legend.frameon": False,
    "legend.fontsize": 8.5,
    "lines.linewidth": 1.3,
    "lines.solid_capstyle": "round",
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
    "figure.dpi": DPI,
    "path.simplify": True,
    "agg.path.chunksize": 20000,
}


@contextmanager
def house_style() -> Iterator[None]:
    """Matplotlib with kalmap's parameters, from its own defaults and not the user's; put back after."""
    import matplotlib

    with matplotlib.rc_context():
        matplotlib.rcdefaults()
        matplotlib.rcParams.update(_RC)
        yield


def new_figure(width: float = WIDTH, height: float = 4.5, dpi: float = DPI) -> Figure:
    """An empty figure on an Agg canvas, size in inches, dots an inch. Call it inside `house_style`."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(width, height), dpi=dpi, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def say(axes: Axes, text: str) -> None:
    """Write in place of a curve why there is none."""
    axes.text(0.5, 0.5, text, transform=axes.transAxes, ha="center", va="center", color=GREY, wrap=True)
    axes.set_xticks([])
    axes.set_yticks([])
    axes.grid(False)


def method_style(index: int) -> dict[str, Any]:
    """Colour and dashes of the index-th method, the same in every figure of a comparison."""
    return {
        "color": METHOD_COLOURS[index % len(METHOD_COLOURS)],
        "linestyle": METHOD_LINES[index % len(METHOD_LINES)],
    }


def finite_maximum(values: np.ndarray, otherwise: float = 1.0) -> float:
    """The largest finite value, or `otherwise` where there is none."""
    finite = values[np.isfinite(values)]
    return float(finite.max()) if len(finite) else otherwise


def png_bytes(figure: Figure) -> bytes:
    """The figure as a PNG, the same bytes for the same figure."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    with house_style():
        # not savefig, which draws twice: once for the layout alone
        FigureCanvasAgg(figure).print_png(stream, metadata={"Software": None})
    return stream.getvalue()


def save_figures(folder: Path | str, figures: Mapping[str, Figure]) -> dict[str, Path]:
    """Save each figure as `<name>.png` in a folder, made if missing. Returns the paths by name."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    paths = {}
    for name, figure in figures.items():
        paths[name] = folder / f"{name}.png"
        paths[name].write_bytes(png_bytes(figure))
    return paths

"""The architectures of ψ_high, ψ_low and φ, the paper's and those that ship, as they are built.

Paper, figures 3 and 4. Every size is read from the weights of the module that trains and predicts,
so that the picture cannot say something else than the code. The maps are real: before a loading,
and as the paper's φ predicts it, from the committed result of `experiments.pile_state`.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import numpy as np
from flax import nnx
from matplotlib.axes import Axes
from matplotlib.patches import Rectangle

from experiments._common.places import RESULTS
from experiments._common.results import main
from wlplan.constants import CELL_SIZE
from wlplan.io import write_bytes_atomic
from wlplan.models.layers import Mlp
from wlplan.models.phi import HeightChange
from wlplan.models.phi_vae import LATENT, PhiVae
from wlplan.models.psi_high import ConvolutionalEncoder, PsiHigh
from wlplan.models.psi_low import PsiLow
from wlplan.models.storage import read_description
from wlplan.report.figures import png_bytes
from wlplan.report.figures.relief import PILE
from wlplan.report.figures.style import BLUE, FAINT, INK, ORANGE, add_arrow, bare_figure
from wlplan.terrain.heightmap import PERFORMANCE_CELLS, STATE_CELLS, STATE_DISPLACEMENT
from wlplan.training.settings import PhiVaeSettings, PsiHighSettings, PsiLowSettings
from wlplan.worlds.shipped import pretrained_path

# Length of the action.
_ACTION = 4
# A convolution sees 3 x 3 cells; its filters are rows of a matrix, see `wlplan.models.layers`.
_KERNEL = 9


@dataclasses.dataclass(frozen=True)
class Stage:
    """What a network holds at one place.

    Attributes:
        shape: Channels and cells a side of maps, or the length of a vector.
        how: How it comes from the stage before; empty if it is an input.
        beside: What is joined to it, an input of its own; empty if nothing.
    """

    shape: tuple[int, ...]
    how: str = ""
    beside: str = ""


def run(preset: str) -> dict[str, Any]:
    """Builds every network, without weights, and reads its sizes."""
    shipped = {
        kind: read_description(pretrained_path(kind), kind)
        for kind in ("psi_high", "psi_low", "phi")
    }

    def built(make: Callable[[nnx.Rngs], Any]) -> Any:
        return nnx.eval_shape(lambda: make(nnx.Rngs(0)))

    of = {kind: one["architecture"] for kind, one in shipped.items()}
    members = {kind: one.get("ensemble", {}).get("members", 1) for kind, one in shipped.items()}
    high = PsiHighSettings(encoder="convolutional", hidden=(2048, 2048))
    low, phi = PsiLowSettings(), PhiVaeSettings()
    networks = {
        "ψ_high, the paper's": (
            built(lambda rngs: PsiHigh(high.hidden, encoder=high.encoder, rngs=rngs)),
            1,
        ),
        "ψ_high, ships": (
            built(
                lambda rngs: PsiHigh(
                    tuple(of["psi_high"]["hidden"]),
                    encoder=of["psi_high"]["encoder"],
                    scattered=of["psi_high"]["scattered"],
                    rngs=rngs,
                )
            ),
            members["psi_high"],
        ),
        "ψ_low, as in table 1": (built(lambda rngs: PsiLow(low.hidden, rngs=rngs)), 1),
        "ψ_low, ships": (
            built(
                lambda rngs: PsiLow(
                    tuple(of["psi_low"]["hidden"]), scattered=of["psi_low"]["scattered"], rngs=rngs
                )
            ),
            members["psi_low"],
        ),
        _PAPERS_PHI: (built(lambda rngs: PhiVae(phi.hidden, rngs=rngs)), 1),
        _OUR_PHI: (
            built(lambda rngs: HeightChange(tuple(of["phi"]["hidden"]), rngs=rngs)),
            members["phi"],
        ),
    }
    return {
        "networks": {
            title: {
                "members": count,
                "parameters": parameters(network),
                "stages": [dataclasses.asdict(stage) for stage in stages(network)],
            }
            for title, (network, count) in networks.items()
        },
        "maps_cm": _maps(),
    }


def parameters(network: Any) -> int:
    """How many numbers of a network are trained."""
    return sum(math.prod(leaf.shape) for leaf in jax.tree.leaves(nnx.state(network, nnx.Param)))


def stages(network: Any) -> list[Stage]:
    """What a network makes of its inputs, stage by stage, with the sizes of its weights."""
    if isinstance(network, PsiHigh):
        return _of_psi_high(network)
    if isinstance(network, PsiLow):
        inputs, _ = network.hidden[0].kernel.shape
        return [Stage((inputs - _ACTION,), beside="a"), Stage((inputs,), "join"), *_of_mlp(network)]
    if isinstance(network, PhiVae):
        return _of_phi_vae(network)
    return _of_phi(network)


def _of_psi_high(network: PsiHigh) -> list[Stage]:
    found = [Stage((1, PERFORMANCE_CELLS))]
    inputs, _ = network.head.hidden[0].kernel.shape
    encoder = network.encoder
    if isinstance(encoder, ConvolutionalEncoder):
        flat, code = encoder.output.kernel.shape
        channels = [layer.kernel.shape for layer in encoder.filters]
        # From the end: what is flattened is square, and every stage before has twice its side.
        side = math.isqrt(flat // channels[-1][1]) << len(channels)
        found.append(Stage((channels[0][0] // _KERNEL, side), "resize"))
        for _, filters in channels:
            side //= 2
            found.append(Stage((filters, side), "3×3, norm,\nact., pool"))
        found.append(Stage((code,), "linear", beside="a"))
    else:
        code = encoder.basis.shape[1]
        found.append(Stage((code,), "principal\ncomponents", beside="h̃, a"))
    return [*found, Stage((inputs,), "join"), *_of_mlp(network.head)]


def _of_mlp(network: Mlp) -> list[Stage]:
    """Hidden layers and outputs; of those that also predict variances, twice the outputs."""
    hidden = [Stage((layer.kernel.shape[1],), "linear,\nact.") for layer in network.hidden]
    outputs = network.output.kernel.shape[1]
    scattered = getattr(network, "scatter", None) is not None
    last = "mean,\nvariance" if scattered else "linear"
    return [*hidden, Stage((outputs * (1 + scattered),), last)]


def _of_phi_vae(network: PhiVae) -> list[Stage]:
    vae = network.vae
    down = [layer.kernel.shape for layer in vae.down]
    flat = vae.code.kernel.shape[0]
    side = math.isqrt(flat // down[-1][1]) << len(down)
    found = [Stage((1, STATE_CELLS)), Stage((1, side), "scale,\nresize")]
    for _, channels in down:
        side //= 2
        found.append(Stage((channels, side), "2×2, stride\n2, act."))
    inputs, _ = network.step.hidden[0].kernel.shape
    found += [Stage((LATENT,), "mean of\nthe code", beside="a, Δh"), Stage((inputs,), "join")]
    found += _of_mlp(network.step)
    found.append(Stage((down[-1][1], side), "linear,\nact."))
    for layer in vae.up:
        side *= 2
        found.append(Stage((layer.kernel.shape[1] // 4, side), "2×2,\nact."))
    return [*found, Stage((1, STATE_CELLS), "resize,\nscale back,\nblend")]


def _of_phi(network: HeightChange) -> list[Stage]:
    inputs, _ = network.weights.hidden[0].kernel.shape
    return [
        Stage((1, STATE_CELLS)),
        Stage((network.before.basis.shape[1],), "principal\ncomponents", beside="a, volume"),
        Stage((inputs,), "join"),
        *_of_mlp(network.weights),
        Stage((1, STATE_CELLS), "patterns of\nthe change,\nmass exact"),
    ]


def _maps() -> dict[str, Any]:
    """A map before a loading, its part that ψ_high sees, and the map after by either φ [cm]."""
    sample = json.loads((RESULTS / "pile_state.json").read_text())["samples"][1]
    before = np.array(sample["before_cm"])
    # Every other cell was kept.
    first, cells = int(0.5 * STATE_DISPLACEMENT / CELL_SIZE), PERFORMANCE_CELLS // 2
    side = (len(before) - cells) // 2
    return {
        "before": before.tolist(),
        "seen by ψ_high": before[first : first + cells, side : side + cells].tolist(),
        _PAPERS_PHI: sample["predicted_cm"]["paper's φ, edges blended"],
        _OUR_PHI: sample["predicted_cm"]["ours, as it ships"],
    }


_PAPERS_PHI, _OUR_PHI = "φ, the paper's", "φ, ships"

# Sizes of the drawing [inch]: a row, from stage to stage, the largest map, the tallest vector.
_ROW, _STEP, _LARGEST, _TALLEST = 1.75, 0.82, 0.62, 0.95
# How many stages to the right of ψ_high ψ_low begins.
_BESIDE = 11.4


def draw(folder: Path) -> None:
    """Maps as stacks of squares, vectors as bars; ψ_low stands beside ψ_high."""
    result = json.loads((folder / "architectures.json").read_text())
    networks = result["networks"]
    longest = max(len(one["stages"]) for one in networks.values())
    titles = list(networks)
    rows = [titles[0:3:2], titles[1:4:2], *([title] for title in titles[4:])]
    width, height = _STEP * (longest + 0.8), _ROW * len(rows)
    figure = bare_figure(width, height)
    panel = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    panel.set_xlim(0.0, width)
    panel.set_ylim(0.0, height)
    panel.set_axis_off()
    maps = {name: np.array(values) for name, values in result["maps_cm"].items()}
    for number, row in enumerate(rows):
        middle = height - _ROW * (number + 0.58)
        for left, title in zip((0.0, _STEP * _BESIDE), row, strict=False):
            network = networks[title]
            copies = f", {network['members']} of them" if network["members"] > 1 else ""
            said = f"{title}: {network['parameters']:,} parameters{copies}"
            panel.text(left + 0.15, middle + 0.82, said, fontsize=9, color=INK, weight="bold")
            seen = "before" if title in maps else "seen by ψ_high"
            around = (maps[seen], maps.get(title))
            _draw_network(panel, network["stages"], (left, middle), around)
    write_bytes_atomic(folder / "architectures.png", png_bytes(figure, dpi=110))


def _draw_network(
    panel: Axes,
    found: list[dict[str, Any]],
    start: tuple[float, float],
    maps: tuple[np.ndarray, np.ndarray | None],
) -> None:
    """One network from a point to the right; the maps are those before and after."""
    left, middle = start
    side = 0.0
    for place, stage in enumerate(found):
        x = left + _STEP * (place + 0.65)
        shape = stage["shape"]
        if place:
            _draw_step(
                panel, x - _STEP + 0.5 * side, x - 0.5 * _extent(shape), middle, stage["how"]
            )
        side = _extent(shape)
        if len(shape) == 1:
            _draw_vector(panel, x, middle, shape[0], of_map=place > 0)
        else:
            shown = {0: maps[0], len(found) - 1: maps[1]}.get(place)
            _draw_map(panel, x, middle, shape, shown)
        if place == len(found) - 1 and maps[1] is None:
            words = "mass, time,\nwork"
            panel.text(x + 0.15, middle, words, fontsize=7, color=INK, va="center")
        if stage["beside"]:
            end = np.array([x + _STEP - 0.1, middle + 0.5])
            panel.text(
                x + 0.3, middle + 0.6, stage["beside"], fontsize=8, color=ORANGE, ha="center"
            )
            begin = np.array([x + 0.35, middle + 0.58])
            add_arrow(panel, begin, end, colour=ORANGE, line=0.9, head=6.0, zorder=5)


def _extent(shape: list[int]) -> float:
    """Width of a stage in the drawing [inch]."""
    if len(shape) == 1:
        return 0.12
    return _side(shape[1]) + 0.025 * min(shape[0] - 1, 8)


def _side(cells: int) -> float:
    return _LARGEST * math.sqrt(cells / 64.0)


def _draw_step(panel: Axes, start: float, end: float, middle: float, how: str) -> None:
    ends = [np.array([x, middle]) for x in (start + 0.03, end - 0.03)]
    add_arrow(panel, *ends, colour=FAINT, line=0.9, head=6.0, zorder=2)
    panel.text(
        0.5 * (start + end), middle - 0.46, how, fontsize=5.8, color=FAINT, ha="center", va="top"
    )


def _draw_vector(panel: Axes, x: float, middle: float, length: int, *, of_map: bool) -> None:
    """A bar; its height goes with the logarithm of the length."""
    tall = _TALLEST * math.log2(1 + length) / 11.0
    colour = BLUE if of_map else ORANGE
    panel.add_patch(
        Rectangle((x - 0.06, middle - 0.5 * tall), 0.12, tall, facecolor=colour, alpha=0.75, lw=0.0)
    )
    panel.text(
        x,
        middle + 0.5 * tall + 0.04,
        f"{length:,}" if of_map else f"h̃: {length}",
        fontsize=7,
        color=INK,
        ha="center",
        va="bottom",
    )


def _draw_map(
    panel: Axes, x: float, middle: float, shape: list[int], height: np.ndarray | None
) -> None:
    """Squares one behind the other, at most nine; or the map itself, the loader digs upward."""
    channels, cells = shape
    size = _side(cells)
    shown = min(channels, 9)
    corner = np.array([x - 0.5 * _extent(shape), middle - 0.5 * size])
    for k in reversed(range(shown)):
        place = corner + 0.025 * k
        panel.add_patch(
            Rectangle(
                (place[0], place[1]),
                size,
                size,
                facecolor="#dfe8f2",
                edgecolor=BLUE,
                lw=0.5,
                zorder=3,
            )
        )
    if height is not None:
        panel.imshow(
            height[:, ::-1],
            origin="lower",
            cmap=PILE,
            extent=(corner[0], corner[0] + size, corner[1], corner[1] + size),
            zorder=4,
            aspect="auto",
        )
    said = f"{cells}×{cells}" if channels == 1 else f"{channels} × {cells}×{cells}"
    top = middle + 0.5 * size + 0.025 * (shown - 1) + 0.04
    panel.text(x, top, said, fontsize=6.5, color=INK, ha="center", va="bottom")


if __name__ == "__main__":
    main("architectures", run, draw)

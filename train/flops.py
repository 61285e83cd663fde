"""`spikerig cost flops`: the paper's Eq. 11 with its symbols counted from the models that train, beside a profiler."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from spikerig.dataset import machine
from spikerig.dataset.errors import UsageError
from spikerig.dataset.terminal import Progress, emit, note

if TYPE_CHECKING:
    from spikerig.train.fit import State, Task

METHODS = ("plain", "average", "spikenerf", "spikenerf-5x")
PRESETS = {"nerf": "paper", "nerf-fast": "draft", "splat": "draft"}
PROFILED_RAYS = 16  # of a step under the profiler; a product of matrices costs in proportion to them
CONVERTER = 3  # products of the learned gray a pixel: n_(L-1) n_L of the paper's converter layer
# Arithmetic of a pair of splat and pixel in native/kernels/raster.cpp, forward and back; e^x counted as 10. An upper
# bound of what is done: pairs whose blocks of 16 pixels a splat does not reach are skipped together.
SPLAT_FORWARD, SPLAT_BACK = 29, 52
CORNER = 8 * (3 + 2 * 2)  # of a point in a level of the hash grid: the weight of eight corners, two features each


@dataclass(frozen=True, slots=True)
class Pass:
    """A network asked at some points in a render: C by Eq. 11, the part of it whose inputs need no gradient, trained?

    `unfed` is n_0 n_1 where the inputs are fixed: the way back has no product for them.
    """

    network: str
    complexity: int
    unfed: int
    points: int
    trained: bool

    @property
    def flops(self) -> int:
        """Forward, and where trained the gradients of weights and of inputs: 2 a product and sum."""
        back = 2 * self.complexity - self.unfed if self.trained else 0
        return 2 * self.points * (self.complexity + back)


def complexity(params: dict[str, Any], network: str) -> int:
    """C = n_0 n_1 + n_1 n_2 + ... of a network: products of a forward pass at one point, without biases.

    Source: paper, Eq. 11. Inputs that skip layers or join late count in the layer that takes them.
    """
    return sum(p.numel() for name, p in params.items() if name.startswith(f"{network}/") and name.endswith("/weight"))


def passes(params: dict[str, Any], config: Any) -> list[Pass]:
    """What one render of a field of rays asks of its networks."""
    rays = config.rays
    if config.field == "nerf":
        samples = {"coarse": config.coarse, "fine": config.coarse + config.fine}
        first = {net: params[f"{net}/1/weight"].numel() for net in samples}
        return [Pass(net, complexity(params, net), first[net], rays * n, True) for net, n in samples.items()]
    density, colour = (complexity(params, net) for net in ("density", "colour"))
    looks = [Pass("density (probes)", density, 0, rays * config.probes, False)] if config.probes else []
    return [
        *looks,
        Pass("density", density, 0, rays * config.fine, True),
        Pass("colour", colour, 0, rays * config.fine, True),
    ]


def renders(task: Task) -> int:
    """Renders of a step once every instant has been drawn: N of the paper."""
    targets, fresh = task.targets, task.config.fresh_poses
    wanted = len(dict.fromkeys((*targets.colour, *targets.tfs, *targets.also)))
    return min(fresh, wanted) if fresh else wanted


def row(task: Task, state: State, *, profile: bool = True) -> dict[str, Any]:
    """Floating-point operations of a step of a method on a field, counted; and those of its matrices as profiled.

    Returns:
        field, method, renders, networks (C and points of each), flops (of networks, or of splats' pairs), grid_flops
        (hash grid, forward and back), converter_flops, profiled (of networks at this size; None for splats), converter
        share of the rest.
    """
    config, count = task.config, renders(task)
    made: dict[str, Any] = {"field": config.field, "method": config.method, "preset": config.preset, "renders": count}
    textured = len(task.targets.tfs) if task.weight > 0 else 0
    if config.field == "splat":
        pairs = _pairs(task, state)
        pixels = task.camera.width * task.camera.height
        made |= {"pairs_a_render": pairs, "flops": count * pairs * (SPLAT_FORWARD + SPLAT_BACK), "grid_flops": 0}
        made |= {"networks": {}, "profiled": None}
    else:
        asked = passes(state.params, config)
        pixels = config.rays
        made["networks"] = {p.network: {"C": p.complexity, "points": p.points, "trained": p.trained} for p in asked}
        made["flops"] = count * sum(p.flops for p in asked)
        made["grid_flops"] = count * _grid(asked, config)
        made["profiled"] = _profiled(task, state) * config.rays / PROFILED_RAYS if profile else None
    networks = 2 if config.field == "nerf" else 1
    made["converter_flops"] = 2 * 3 * CONVERTER * pixels * min(textured, count) * networks
    made["converter_share"] = made["converter_flops"] / (made["flops"] + made["grid_flops"])
    return made


def _grid(asked: list[Pass], config: Any) -> int:
    if config.field != "nerf-fast":
        return 0
    fed = sum(p.points * (2 if p.trained else 1) for p in asked if p.network.startswith("density"))
    return fed * config.grid_levels * CORNER


def _pairs(task: Task, state: State) -> int:
    """Splats consulted over all pixels of a render, mean over the training views."""
    from spikerig.train.bench import consulted

    model: Any = task.model(state)
    seen = [consulted(model.draw(next(iter(view.instants.values())).pose)) for view in task.targets.views]
    return round(sum(seen) / len(seen))


def _profiled(task: Task, state: State) -> float:
    """What torch's profiler counts for the matrix products of a step of PROFILED_RAYS rays."""
    from torch.profiler import ProfilerActivity, profile

    from spikerig.train.fit import step_of, view_loss

    small = replace(task, config=replace(task.config, rays=PROFILED_RAYS))
    view, step = step_of(state, small, 0.5)
    with profile(activities=[ProfilerActivity.CPU], with_flops=True) as seen:
        view_loss(state, small, view, step).backward()
    for p in state.params.values():
        p.grad = None
    return float(sum(event.flops or 0 for event in seen.key_averages() if event.key in ("aten::mm", "aten::addmm")))


def count_scene(
    scene: Path, methods: tuple[str, ...], names: tuple[str, ...], *, profile: bool
) -> list[dict[str, Any]]:
    """`row` for every field and method, on one scene; `over_plain`: all operations against plain's on that field."""
    from spikerig.dataset.store import open_scene
    from spikerig.train.fit import new_state, torch_threads
    from spikerig.train.methods import configure
    from spikerig.train.run import prepare

    bar, rows = Progress("cost flops", len(methods) * len(names), "rows"), []
    with open_scene(scene) as file, torch_threads():
        for name in names:
            for method in methods:
                task = prepare(file, scene, configure(method, PRESETS[name], name))[0]
                rows.append(row(task, new_state(file.points, task), profile=profile))
                bar.step(extra=f"{name} {method}")
    for each in rows:
        plain = [r for r in rows if r["field"] == each["field"] and r["method"] == "plain"]
        each["over_plain"] = _all(each) / _all(plain[0]) if plain else None
    return rows


def _all(each: dict[str, Any]) -> float:
    return each["flops"] + each["grid_flops"] + each["converter_flops"]


def flops(
    scene: Annotated[Path, typer.Argument(help="A scene file (.h5) with spikes.")],
    methods: Annotated[str, typer.Option(help="Methods, with commas between.")] = ",".join(METHODS),
    names: Annotated[str, typer.Option("--fields", help="Fields, with commas between.")] = ",".join(PRESETS),
    profile: Annotated[bool, typer.Option(help="Run a small step of each under torch's profiler too.")] = True,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON document on stdout.")] = False,
) -> None:
    """Operations of a training step by the paper's Eq. 11, counted from the real models and checked by a profiler."""
    asked = tuple(names.split(","))
    if strange := sorted(set(asked) - set(PRESETS)):
        raise UsageError("no such field", value=", ".join(strange), expected=", ".join(PRESETS))
    rows, where = count_scene(scene, tuple(methods.split(",")), asked, profile=profile), machine.describe()
    if as_json:
        emit("spikerig.cost.flops/1", {"rows": rows, "machine": where, "command": machine.command()})
        return
    typer.echo(
        f"{'field':<10} {'method':<13} {'N':>2} {'GFLOP':>10} {'profiler':>10} {'grid':>8} {'gray':>9} {'x plain':>8}"
    )
    for each in rows:
        told = "-" if each["profiled"] is None else f"{each['profiled'] / 1e9:.3f}"
        over = "-" if each["over_plain"] is None else f"{each['over_plain']:.3f}"
        typer.echo(
            f"{each['field']:<10} {each['method']:<13} {each['renders']:>2} {each['flops'] / 1e9:>10.3f} {told:>10} "
            f"{each['grid_flops'] / 1e9:>8.3f} {each['converter_share']:>9.1e} {over:>8}"
        )
    for each in rows:
        if each["method"] == rows[0]["method"] and each["networks"]:
            told = "; ".join(f"{n}: C = {v['C']:,} at {v['points']:,} points" for n, v in each["networks"].items())
            note(f"{each['field']} ({each['preset']}): {told}")
    note("N renders a step; GFLOP of networks (splats: of pairs of splat and pixel, at the start); gray: its share")

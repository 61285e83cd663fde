"""When a fit diverges: find the very step, keep the state before it, and look at that step again.

Every CHECK_EVERY steps the loop looks for values that are not finite, so the first of them may be up to so many steps
old. The guard keeps the state of the last good look; a step depends on nothing but state and config, so it can be
taken again from there, this time looking after each step.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from spikerig.dataset.errors import NumericsError
from spikerig.train.fit import (
    CHECK_EVERY,
    State,
    Task,
    check_finite,
    fraction_done,
    one_step,
    save_state,
    step_of,
    torch_threads,
    view_loss,
)
from spikerig.train.record import DIVERGED


def copy_state(state: State) -> State:
    """A state that later steps leave alone (remembered renders are replaced, never changed, and are shared)."""
    leaves = {name: p.detach().clone().requires_grad_() for name, p in state.params.items()}
    moments = {name: (mean.clone(), square.clone()) for name, (mean, square) in state.moments.items()}
    grids = {name: grid.clone() for name, grid in state.grids.items()}
    return replace(
        state, params=leaves, moments=moments, grids=grids, history=list(state.history), memory=dict(state.memory)
    )


@dataclass(slots=True)
class Guard:
    """Keeps the last state that was seen to be finite; called after every step.

    Cost: a copy of parameters, moments and grids every CHECK_EVERY steps, and the memory for one.
    """

    kept: State

    def __call__(self, state: State) -> None:
        """Keep the state if this is a step after which the loop has looked."""
        if (state.step - 1) % CHECK_EVERY == 0:
            self.kept = copy_state(state)


def find(kept: State, task: Task) -> tuple[State, NumericsError] | None:
    """The state before the first step from `kept` that leaves something not finite, and what is told of that step.

    None where nothing breaks within two looks of the loop: then the failure does not come again (a run by seconds whose
    learning rates fall with the clock, a device whose sums have no order).
    """
    state = copy_state(kept)
    with torch_threads(task.field.torch_threads()):
        for _ in range(2 * CHECK_EVERY):
            before = copy_state(state)
            try:
                one_step(state, task, fraction_done(state, task.config))
                check_finite(state)
            except NumericsError as error:
                return before, error
            if fraction_done(state, task.config) >= 1:
                return None
    return None


def reproducer(out: Path, kept: State, task: Task, error: NumericsError) -> NumericsError:
    """Write the state before the step that broke into the run's folder; returns the error to raise, which names it.

    Args:
        out: folder of the run; gets diverged.safetensors, a checkpoint in all respects.
        kept: the last state that was finite.
        task: of the fit.
        error: as the loop raised it.
    """
    found = find(kept, task)
    before, told = (kept, error) if found is None else found
    save_state(out / DIVERGED, before, task.config)
    again = "" if found is not None else " (taken again from the last finite state, it did not break)"
    return NumericsError(
        told.what + again,
        value=told.value,
        expected=told.expected,
        cause=told.cause,
        next=f"spikerig train diverged {out} shows the step again; " + told.next,
    )


def examine(state: State, task: Task) -> dict[str, Any]:
    """One step taken slowly: what is finite, what is not, and how large the largest numbers are.

    Args:
        state: before the step; left as it is.
        task: of the fit.

    Returns:
        step, fraction, view, loss, error (of the step, or None), and per tensor its values, gradient and value after
        the step, each {not_finite, first, largest}.
    """
    state = copy_state(state)
    fraction = fraction_done(state, task.config)
    view, step = step_of(state, task, fraction)
    found: dict[str, Any] = {"step": state.step, "fraction": fraction, "view": view.name, "loss": None, "error": None}
    tensors: dict[str, dict[str, Any]] = {name: {"value": _about(p)} for name, p in state.params.items()}

    def attempt(action: Callable[[], Any]) -> Any:
        try:
            return action()
        except NumericsError as error:
            found["error"] = found["error"] or error.what
            return None

    with torch_threads(task.field.torch_threads()):
        loss = attempt(lambda: view_loss(state, task, view, step))
        if loss is not None:
            found["loss"] = loss.item()
            if loss.requires_grad:
                loss.backward()
        for name, p in state.params.items():
            tensors[name]["gradient"] = None if p.grad is None else _about(p.grad)
        again = copy_state(state)
        attempt(lambda: one_step(again, task, fraction))
    for name, p in again.params.items():
        tensors[name]["after"] = _about(p)
    return {**found, "tensors": tensors}


def _about(values: torch.Tensor) -> dict[str, Any]:
    values = values.detach()
    finite = torch.isfinite(values)
    bad = torch.nonzero(~finite)
    largest = torch.where(finite, values, 0).abs().max().item() if values.numel() else 0.0
    return {"not_finite": len(bad), "first": bad[0].tolist() if len(bad) else None, "largest": largest}

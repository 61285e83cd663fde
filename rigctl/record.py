"""The record loop: one for every rig, real or emulated, over the three Protocols of `devices`."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from spikerig.dataset.clocktime import NS
from spikerig.dataset.errors import DeviceError
from spikerig.dataset.marks import Reset
from spikerig.dataset.rawtake import TakenView
from spikerig.rigctl.devices import Clip, FrameSource
from spikerig.rigctl.gopro_check import clip_findings
from spikerig.rigctl.live import LOOK_TICKS, judge, look
from spikerig.rigctl.operator import Interrupt, Operator
from spikerig.rigctl.pulse import Pulse
from spikerig.rigctl.recorder import Recorder
from spikerig.rigctl.take_plan import TakePlan
from spikerig.rigctl.take_writer import TakeWriter
from spikerig.rigctl.tally import Rig, Tally, write_truth

SLICE_NS = NS // 50  # between looks at whether to stop
GO, RETAKE, SKIP, QUIT, CHECK = "", "r", "s", "q", "c"
LOUD = ("transport", "recorder", "ring", "stopped", "silent", "device", "fault", "direct-io", "set-aside",
        "clip")  # fmt: skip


class Stopped(Exception):  # not an error: the operator's wish
    """The operator ends the take here."""


def record(plan: TakePlan, rig: Rig, folder: Path, operator: Operator, *, resume: bool = False) -> Tally:
    """Record a take: every viewpoint of the plan that is not kept yet.

    Args:
        plan: what to record.
        rig: the devices, open.
        folder: of the take; made, or with `resume` gone on with.
        operator: asked and told.

    Returns:
        What came of it; status "complete" when no viewpoint is left, else "aborted".

    Raises:
        UsageError, HostError: as `TakeWriter`; DeviceError: a device that is needed failed for good. The take can then
            be gone on with, and everything acknowledged is in it.
        KeyboardInterrupt: Ctrl-C, after all was closed in good order.
    """
    writer = TakeWriter.resume(folder, plan) if resume else TakeWriter.begin(folder, plan, rig.facts)
    interrupt = Interrupt(operator.say)
    loop: Loop | None = None
    with interrupt.watching():
        try:
            loop = Loop(plan, rig, writer, operator, interrupt)
            loop.run()
        except Stopped:
            pass
        finally:
            tally = _end(loop, writer, rig)
    if interrupt.wanted:
        raise KeyboardInterrupt
    return tally


def _end(loop: Loop | None, writer: TakeWriter, rig: Rig) -> Tally:
    """Close everything, whatever happened."""
    tally = loop.tally if loop is not None else Tally()
    try:
        if loop is not None:
            loop.close()
    finally:
        if rig.truth is not None:
            write_truth(writer.folder, rig.truth())
        tally.status = "complete" if loop is not None and loop.done else "aborted"
        writer.sync()
        writer.status(tally.status)
        writer.close()
    return tally


class Loop:
    """One run of the loop; `record` is the way in."""

    def __init__(self, plan: TakePlan, rig: Rig, writer: TakeWriter, operator: Operator, interrupt: Interrupt) -> None:
        self.plan, self.rig, self.writer, self.operator, self.interrupt = plan, rig, writer, operator, interrupt
        self.host = rig.host
        self.began_ns = self.host.now_ns()
        kept = {name for name, view in writer.views.items() if view.kept}
        self.left = [name for name in plan.viewpoints if name not in kept]
        self.tally = Tally(viewpoints=len(plan.viewpoints), kept=len(plan.viewpoints) - len(self.left))
        self.best_focus = max((v.checks.get("focus") or 0.0 for v in writer.views.values() if v.kept), default=0.0)
        self.recorder = Recorder(
            rig.spike, writer.folder / "spikes", self.host, writer.number, first=writer.first_chunk,
            first_epoch=writer.first_epoch, options=plan.recorder.options(), event=self._event,
        )  # fmt: skip
        self.pulse = Pulse(
            self.host, rig.box, rig.rgb, self.recorder, round(plan.sync.probe_s * NS), writer.mark, self._event
        )  # fmt: skip
        self._started = self.done = False

    def run(self) -> None:
        """All viewpoints that are left, then the clips."""
        if self.writer.last_ns:
            self.writer.mark([Reset("host", 1, self.host.now_ns(), "the take was gone on with")])
        if self.rig.rgb is not None:
            told = self.rig.rgb.settle(self.plan.rgb.settings)
            self._event({"host_ns": self.host.now_ns(), "kind": "settled", "settings": dict(told)})
        self.recorder.start()
        self._started = True
        self.pulse.start()
        numbers = {name: k for k, name in enumerate(self.plan.viewpoints)}
        for name in list(self.left):
            self._viewpoint(name, numbers[name])
        self.fetch()
        self.done = not self.left

    def close(self) -> None:
        """Stop all threads; the files are closed."""
        self.pulse.close()
        try:
            if self._started:
                self.recorder.close()
        finally:
            state = self.recorder.state()
            epoch, seen = self.recorder.position()
            self._event({"host_ns": self.host.now_ns(), "kind": "end", "epoch": epoch, "bytes": seen,
                         "suspect_bytes": self.recorder.doubtful_bytes})  # fmt: skip
            self.tally.bytes, self.tally.chunks = state.kept_bytes, state.chunks
            self.tally.high_water, self.tally.slots = state.high_water, state.slots
            self.tally.seconds = (self.host.now_ns() - self.began_ns) / NS

    # one viewpoint

    def _viewpoint(self, name: str, number: int) -> None:
        before = self.writer.views.get(name)
        attempt = before.attempt if before else 0
        title = f"viewpoint {name} ({number + 1} of {len(self.plan.viewpoints)})"
        if self.plan.advance == "prompt" and not self._ready(title):
            self.tally.skipped.append(name)
            return
        self.rig.place(number)
        if self.plan.advance == "auto":
            self._wait(round(self.plan.settle_s * NS))
        tried = 0
        while True:
            attempt, tried = attempt + 1, tried + 1
            view = self._take(name, attempt)
            amiss = judge(self.plan.checks, view.checks, self.best_focus)
            whole = bool(view.spikes) and not view.checks.get("clip_ended_early")
            view = replace(view, checks={**view.checks, "amiss": amiss})
            self.operator.say(f"  {title}: {self._figures(view.checks)}")
            for line in amiss:
                self.operator.say(f"  !! {line}")
            if not view.spikes and self.plan.advance == "auto" and tried >= self.plan.tries:
                raise DeviceError("the spike camera gives no bytes", value=name, next="mend it, then --resume")
            if not whole and self.plan.advance == "auto" and tried >= self.plan.tries:
                raise DeviceError("the RGB camera ends its recordings early", value=name,
                                  cause=str(view.checks["rgb_trouble"]), next="mend it, then --resume")  # fmt: skip
            if self._good_enough(amiss, tried, whole):
                break
            self.writer.view(replace(view, kept=False))
            self.tally.retaken += 1
        self.writer.sync()
        self.writer.view(view)
        self.left.remove(name)
        self.tally.kept += 1
        self.tally.lost_ticks += view.checks["lost_ticks"]
        self.best_focus = max(self.best_focus, view.checks["focus"] or 0.0)
        if amiss:
            self.tally.poor[name] = amiss

    def _ready(self, title: str) -> bool:
        """Ask until the operator goes; False: skip."""
        keys = {GO: "take it", CHECK: "look again", SKIP: "skip it", QUIT: "end here"}
        while True:
            answer = self._ask(f"{title}: bring the rig there.", keys)
            if answer == CHECK:
                self.operator.say("  " + self._figures(self._look()))
                continue
            if answer == QUIT:
                raise Stopped
            return answer != SKIP

    def _good_enough(self, amiss: list[str], tried: int, whole: bool) -> bool:
        if self.plan.advance == "auto":
            return not amiss or tried >= self.plan.tries
        keys = {GO: "keep it", RETAKE: "take it again", QUIT: "end here, without it"}
        if amiss:
            keep = {GO: "keep it all the same"} if whole else {}
            keys = {RETAKE: keys[RETAKE], **keep, QUIT: keys[QUIT]}
        answer = self._ask("  keep?", keys)
        if answer == QUIT:
            raise Stopped
        return answer == GO

    def _take(self, name: str, attempt: int) -> TakenView:
        """Spikes and a clip of one attempt; on any end the camera stops and what came is on disk."""
        lost, start = self._lost_ticks(), self.host.now_ns()
        clip: Clip | None = None
        spans: list[tuple[int, int, int]] = []
        told: dict[str, Any] = {}
        lead_ns = round(self.plan.rgb.lead_s * NS) if self.rig.rgb else 0
        self._rgb(lambda rgb: rgb.start())
        try:
            self._wait(lead_ns)
            self.recorder.keep()
            begun = self.host.now_ns()
            told = self._look()
            self._wait(begun + round(self.plan.seconds * NS) - self.host.now_ns())
            spans = self.recorder.pause()
            self._wait(lead_ns)
            told |= self._rgb(_rgb_state) or {}
        finally:
            spans = spans or self.recorder.pause()
            clip = self._rgb(lambda rgb: rgb.stop())
        trouble = self.recorder.state().trouble
        if self.recorder.dead:
            raise DeviceError("recording ended", value=trouble, next="mend it, then --resume")
        wanted = round(self.plan.seconds * self.plan.profile.rate_hz)
        short = wanted - sum(b - a for _, a, b in spans) // self.plan.profile.tick_bytes
        told |= {
            "lost_ticks": max(self._lost_ticks() - lost, short),
            "sync_us": self.pulse.residual_us(),
            "free_bytes": shutil.disk_usage(self.writer.folder).free,
        }
        told_clip = None if clip is None else asdict(clip)
        return TakenView(name, attempt, start, self.host.now_ns(), tuple(spans), (), told, True, told_clip)

    def _rgb(self, what: Callable[[FrameSource], Any]) -> Any:
        if self.rig.rgb is None:
            return None
        self.pulse.hold_rgb()
        try:
            return what(self.rig.rgb)
        finally:
            self.pulse.rgb_free.release()

    def fetch(self) -> None:
        """Bring the clips of kept viewpoints that are not here yet."""
        rgb = self.rig.rgb
        if rgb is None:
            return
        for view in list(self.writer.views.values()):
            if not view.kept or view.clip is None or view.clips:
                continue
            made = view.clip
            clip = Clip(made["name"], made["size_bytes"], tuple(made["start_ns"]), tuple(made["stop_ns"]))
            self.operator.say(f"  fetching {clip.name} of {view.name}, {clip.size_bytes / 1e6:.1f} MB")
            self._stop_if_asked()
            paths = self._rgb(lambda rgb, clip=clip: rgb.fetch(clip, self.writer.folder / "rgb"))
            found = clip_findings(self.plan.rgb.settings, paths)
            checks = {**view.checks, "clip": found}
            self.writer.view(replace(view, clips=tuple(p.name for p in paths), checks=checks))
            for told in found:
                words = f"{told['importance']}: {view.name}, {told['where']}: {told['message']}"
                at_ns = self.host.now_ns()
                self._event({"host_ns": at_ns, "kind": "clip", "view": view.name, **told, "words": words})

    # small things

    def _look(self) -> dict[str, Any]:
        data = self.recorder.peek(LOOK_TICKS)
        if data is None:
            return {"exposure": None, "saturated": None, "focus": None}
        return asdict(look(data, self.plan.profile))

    def _figures(self, told: Mapping[str, Any]) -> str:
        if told["exposure"] is None:
            return "no bytes come from the spike camera"
        focus = told["focus"] / self.best_focus if self.best_focus else 1.0
        parts = [f"exposure {told['exposure']:.3f}", f"saturated {told['saturated']:.1%}", f"focus {focus:.0%}"]
        if "lost_ticks" in told:
            sync = "-" if told["sync_us"] is None else f"{told['sync_us']:.0f} us"
            parts += [f"sync {sync}", f"lost {told['lost_ticks']}", f"disk {told['free_bytes'] / 1e9:.0f} GB"]
        return ", ".join(parts)

    def _lost_ticks(self) -> int:
        state = self.recorder.state()
        return -(-(state.lost_transport + state.lost_recorder) // self.plan.profile.tick_bytes)

    def _wait(self, ns: int) -> None:
        until = self.host.now_ns() + ns
        while self.host.now_ns() < until:
            self._stop_if_asked()
            self.host.sleep_until(min(until, self.host.now_ns() + SLICE_NS))

    def _stop_if_asked(self) -> None:
        if self.interrupt.wanted:
            raise Stopped

    def _ask(self, question: str, keys: Mapping[str, str]) -> str:
        self._stop_if_asked()
        self.interrupt.asking = True
        try:
            return self.operator.ask(question, keys)
        except KeyboardInterrupt:
            self.interrupt.wanted = True
            raise Stopped from None
        finally:
            self.interrupt.asking = False

    def _event(self, told: Mapping[str, Any]) -> None:
        self.writer.log(told)
        if told["kind"] in LOUD:
            self.operator.say(f"  !! {told.get('words', told['kind'])}")


def _rgb_state(rgb: FrameSource) -> dict[str, Any]:
    """What the RGB camera says while its recording should still run."""
    told = rgb.poll()
    return {"clip_ended_early": bool(told.get("ended_early")), "rgb_trouble": str(told.get("trouble") or "")}

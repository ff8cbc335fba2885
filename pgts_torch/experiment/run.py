"""Train from a configuration: build the algorithm, iterate, log, save, summarise."""

import copy
import json
import math
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import asdict
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.certificate import CONFIDENCE
from pgts_torch.agent.evaluate import Score, evaluate
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.ranks import joined_ranks
from pgts_torch.agent.states import check_keys, load_checked
from pgts_torch.config import Config
from pgts_torch.config.sections import EvalConfig
from pgts_torch.errors import Failed, ModelMismatch, NotFinite, PgtsError, Stopped, check_count, failure
from pgts_torch.experiment import checkpoint, diagnostics
from pgts_torch.experiment.advice import Movement, greedy_is_worse, learned_little, span_of
from pgts_torch.experiment.checkpoint import Notes
from pgts_torch.experiment.evaluate import KINDS
from pgts_torch.experiment.locking import RunLock
from pgts_torch.experiment.opening import check_dir, claimed, opened
from pgts_torch.experiment.ownership import BEST_FILE, FAILURE_FILE, SUMMARY_FILE
from pgts_torch.experiment.progress import Reporter
from pgts_torch.experiment.resume import Start, find, flat, resuming
from pgts_torch.experiment.signals import StopFlag
from pgts_torch.experiment.summary import EndedBy, Summary
from pgts_torch.experiment.tracking import Folder, NoFolder, event_writer, versions
from pgts_torch.tabular import exact, stationary

MOST_SECONDS = 60
"""The most seconds between two checkpoints, up to one iteration."""


def build(config: Config) -> PGTS:
    """The algorithm that a configuration describes.

    Raises:
        PgtsError: the environment does not exist or has no model, or parts do not fit it.
    """
    return PGTS(**config.arguments())


def train(config: Config, *, strict_resume: bool = False, any_world_size: bool = False) -> Summary:
    """Run a configuration to its end and leave a run folder.

    If the folder holds an unfinished run of this configuration, the training goes on from its last checkpoint, and
    ends with the same bits as if it had never been cut off.

    Processes that torchrun has started train together; the first one writes and speaks for all.

    Args:
        strict_resume: refuse a last checkpoint that is damaged or of other versions, which otherwise is a warning.
        any_world_size: go on with another number of processes than before.

    Raises:
        PgtsError: something in the configuration cannot be built, or the folder is taken; nothing was written.
        Failed: the environment failed in training; where stands in failure.json.
        NotFinite: training met a number that is not finite; which and where stands in failure.json, too.
        ModelMismatch: the environment contradicted its model; what happened stands in failure.json.
        Stopped: SIGTERM, SIGINT or SIGHUP came; the iteration was finished and saved.
        RankLost: another process is gone; the last checkpoint is what remains.
    """
    torch.set_num_threads(config.threads)
    if config.run.tensorboard:
        event_writer()
    with joined_ranks(config.device) as ranks, StopFlag() as stop, ExitStack() as held:
        ranks.first("the run folder", lambda: check_dir(config))
        algorithm = ranks.together("the algorithm", lambda: build(config))
        movement = Movement(copy.deepcopy(algorithm.policy))
        locks: list[RunLock] = []

        def claim() -> tuple[Path, Start | None]:
            locks.append(held.enter_context(claimed(config)))
            path = locks[0].path
            if config.run.overwrite:
                return path, None
            found = find(config, path, strict=strict_resume, world_size=ranks.size, any_world_size=any_world_size)
            if found is not None:
                found.check(algorithm)
            return path, found

        path, start = ranks.first("where to begin", claim)
        if start is not None:
            ranks.together("the saved state", lambda: start.load(algorithm))
        folder: Folder = NoFolder(path)

        def open_folder() -> None:
            nonlocal folder
            folder = held.enter_context(opened(config, locks[0], start))

        ranks.first("an open folder", open_folder)
        if ranks.leads and (why := _out_of_reach(config, algorithm)):
            print(f"note: {why}", file=sys.stderr)
        summary = _loop(config, algorithm, folder, start, stop, movement)
        folder.text(SUMMARY_FILE, json.dumps(asdict(summary), indent=2) + "\n")
    return summary


def _out_of_reach(config: Config, algorithm: PGTS) -> str:
    """Why search.stop_at cannot be reached by any certificate; empty where it can."""
    target, certificates, episodes = config.search.stop_at, algorithm.certificates, config.rollout.num_envs
    if target is None or certificates is None or certificates.trust != "sampled starts":
        return ""
    if (least := certificates.width(episodes)) <= target:
        return ""
    return (
        f"search.stop_at is {target}, which ends nothing: start states are known from the {episodes} episodes of an "
        f"iteration only, and from so many no certificate is below {least:.3g}"
    )


def _loop(
    config: Config, algorithm: PGTS, folder: Folder, start: Start | None, stop: StopFlag, movement: Movement
) -> Summary:
    recorder = _Recorder(config, algorithm, folder, stop, movement)
    if start is not None:
        recorder.load(start)
    try:
        try:
            if not recorder.finished:
                algorithm.learn(config.total_steps, callback=recorder)
        finally:
            recorder.report.close()
        recorder.save()
        if not recorder.finished:
            signals = algorithm.ranks.gather("signals", lambda: stop.signal)
            again = resuming(folder.path, algorithm.ranks.size, config.env.id)
            raise Stopped(
                f"stopped at step {algorithm.num_env_steps}; `{again}` goes on",
                next(each for each in signals if each is not None),
            )
        return algorithm.ranks.first("a summary", recorder.finish)
    except (NotFinite, ModelMismatch, Failed) as error:
        where = {"iteration": algorithm.num_iterations, "env_step": algorithm.num_env_steps, "seed": config.seed}
        tensor = error.what if isinstance(error, NotFinite) else None
        record = where | {"tensor": tensor, "message": str(error)}
        folder.text(FAILURE_FILE, json.dumps(record, indent=2) + "\n")
        raise failure(f"iteration {algorithm.num_iterations} of {folder.path} stopped", error) from error


class _Recorder:
    """The callback of a run: logs, evaluates and saves after each iteration.

    The logged metrics describe the policy that collected the episodes, which is the one before the update.
    """

    def __init__(self, config: Config, algorithm: PGTS, folder: Folder, stop: StopFlag, movement: Movement) -> None:
        self.movement = movement
        self._last: Iteration | None = None
        self.config, self.algorithm, self.folder, self.stop = config, algorithm, folder, stop
        self.ended_by: EndedBy | None = None
        is_known = algorithm.world.mdp is not None and algorithm.ranks.leads
        self.truth = diagnostics.Truth(algorithm) if is_known else None
        self.report = Reporter(config.total_steps, shown=algorithm.ranks.leads)
        self._clock = time.perf_counter()
        self._started = self._saved_clock = self._clock
        self._saved_at = -1
        self._pi_SA = self._table()
        self._deepest, self._certificate = 0, math.inf
        self._evaluations = _evaluations(config.eval, config.seed, folder)

    @property
    def finished(self) -> bool:
        """Whether the training is complete, not only interrupted."""
        return self.ended_by is not None

    def __call__(self, algorithm: PGTS, iteration: Iteration) -> bool:
        """Log, evaluate and save; False ends the training."""
        seconds = time.perf_counter() - self._clock
        k, step = algorithm.num_iterations, algorithm.num_env_steps
        self._deepest, self._certificate = max(self._deepest, iteration.depth), iteration.certificate
        self._last = iteration
        self.movement.follow(algorithm, iteration)
        if k % self.config.log.every == 0 and algorithm.ranks.leads:
            tags = diagnostics.metrics(algorithm, iteration)
            if self.truth is not None and self._pi_SA is not None:
                tags |= self.truth.metrics(self._pi_SA, iteration)
            tags["charts/SPS"] = iteration.experience.num_steps / seconds
            self.folder.log(step, tags)
            self.report.line(step, tags)
        go_on = [evaluation(algorithm, iteration) for evaluation in self._evaluations.values()]
        if tags := {tag: value for kind in self._evaluations for tag, value in self._scores(kind, step)}:
            self.folder.log(step, tags)
        target = self.config.search.stop_at
        if target is not None and iteration.certificate <= target:
            self.ended_by = "certificate"
        elif not all(go_on):
            self.ended_by = "return"
        elif step >= self.config.total_steps:
            self.ended_by = "total_steps"
        every = self.config.log.checkpoint_every
        is_due = every and (k % every == 0 or algorithm.ranks.first("the time", self._is_checkpoint_due))
        if is_due and not self.finished:  # the last one waits until the training has ended
            self.save()
        self._pi_SA = self._table()
        self._clock = time.perf_counter()
        return not self.finished and self.stop.signal is None

    def _is_checkpoint_due(self) -> bool:
        """Whether the last checkpoint is more than `MOST_SECONDS` old."""
        return time.perf_counter() - self._saved_clock > MOST_SECONDS

    def save(self) -> None:
        """Write a checkpoint, unless there is one of this step."""
        if self._saved_at == self.algorithm.num_env_steps:
            return
        if self._last is not None:
            self.movement.measure(self.algorithm, self._last)
        progress = {
            "ended_by": self.ended_by,
            "depth": self._deepest,
            "certificate": None if math.isinf(self._certificate) else self._certificate,
            "seconds": time.perf_counter() - self._started,
            "evaluations": {kind: evaluation.state_dict() for kind, evaluation in self._evaluations.items()},
            "movement": self.movement.state_dict(),
        }
        notes = Notes(
            iterations=self.algorithm.num_iterations,
            env_steps=self.algorithm.num_env_steps,
            model_calls=self.algorithm.num_model_calls,
            config=flat(self.config),
            versions=versions(),
            world_size=self.algorithm.ranks.size,
            files=self.folder.flush(),
            finished=self.finished,
            progress=progress,
        )
        checkpoint.write(self.folder.path, self.algorithm, notes, keep=self.config.log.keep)
        self._saved_at, self._saved_clock = self.algorithm.num_env_steps, time.perf_counter()

    def load(self, start: Start) -> None:
        """Resume from what `save` wrote; the algorithm itself is loaded already. PgtsError if it is something else."""
        notes, progress = start.notes, start.notes.progress
        check_keys("progress", progress, {"ended_by", "depth", "certificate", "seconds", "evaluations", "movement"})
        plain = {name: value for name, value in progress.items() if name != "movement"}
        load_checked("progress", plain, self._take, lambda: plain)
        self.movement.load_state_dict(progress["movement"])
        self._saved_at = notes.env_steps
        if start.lost_best:
            best = self._evaluations["deterministic"]
            best.reset()
            assert best.best_path is not None
            self.algorithm.save(best.best_path)

    def _take(self, progress: Mapping[str, Any]) -> None:
        if progress["ended_by"] not in (None, *get_args(EndedBy)):
            raise PgtsError(f"ended_by is {progress['ended_by']!r}")
        check_count("depth", progress["depth"], least=0)
        self.ended_by, self._deepest = progress["ended_by"], progress["depth"]
        self._certificate = math.inf if progress["certificate"] is None else float(progress["certificate"])
        self._started -= progress["seconds"]
        evaluations = dict(progress["evaluations"])
        for kind, evaluation in self._evaluations.items():
            if kind in evaluations:
                state = evaluations[kind]
                load_checked(f"evaluations.{kind}", state, evaluation.load_state_dict, evaluation.state_dict)

    def _scores(self, kind: str, step: int) -> Iterator[tuple[str, float]]:
        """The tags of the evaluation made at this step, if there was one."""
        history = self._evaluations[kind].history
        if not history or history[-1].env_steps != step:
            return
        for name in ("episodic_return", "episodic_length"):
            score: Score = getattr(history[-1].evaluation, name)
            short = name.removeprefix("episodic_")
            yield f"eval/{kind}_{short}", score.mean
            if score.half_width is not None:
                yield f"eval/{kind}_{short}_half_width", score.half_width

    def _certified(self) -> dict[str, Any]:
        """The certificate's fields of the summary. A proof is made again for the policy after its last update."""
        certificates, bound = self.algorithm.certificates, self._certificate
        trust = None if certificates is None else certificates.trust
        if certificates is not None and trust == "proved":
            bound = certificates.of(self.algorithm.policy_table())
            if self.ended_by == "certificate":  # its policy was kept, and all ranks know of it
                bound = min(bound, self._certificate)
        return {
            "certificate": bound if math.isfinite(bound) else None,
            "certificate_is_proved": trust == "proved",
            "certificate_confidence": CONFIDENCE if trust == "sampled starts" else 1.0,
        }

    def _table(self) -> Tensor | None:
        """The policy in all states, where there is an exact MDP."""
        return None if self.truth is None else self.algorithm.policy_table()

    def finish(self) -> Summary:
        """Draw the policy and summarise the run."""
        seconds = time.perf_counter() - self._started
        config, algorithm, exactly = self.config, self.algorithm, dict[str, float | None]()
        assert self.ended_by is not None
        if self.truth is not None:
            from pgts_torch.experiment.pictures import policy_picture  # matplotlib, a fifth of what a start takes

            pi_SA = algorithm.policy_table()
            title = f"{config.env.id}, depth {config.search.depth}, seed {config.seed}"
            self.folder.picture("policy", policy_picture(algorithm.mdp, pi_SA, title=title), algorithm.num_env_steps)
            exactly = {
                "J": exact.evaluate(algorithm.mdp, pi_SA).J,
                "J_optimal": self.truth.optimum.J,
                "stationarity_gap": float(stationary.gap(algorithm.mdp, pi_SA, self._deepest).max()),
            }
        deterministic, sampled = (
            evaluate(algorithm, episodes=config.eval.episodes, deterministic=kind, seed=config.seed)
            for kind in KINDS.values()
        )
        return Summary(
            run=str(self.folder.path),
            seed=config.seed,
            depth=self._deepest,
            search="none" if algorithm.search is None else str(algorithm.search),
            J=exactly.get("J"),
            J_optimal=exactly.get("J_optimal"),
            stationarity_gap=exactly.get("stationarity_gap"),
            **self._certified(),
            ended_by=self.ended_by,
            iterations=algorithm.num_iterations,
            env_steps=algorithm.num_env_steps,
            model_calls=algorithm.num_model_calls,
            seconds=seconds,
            deterministic=deterministic,
            sampled=sampled,
            parts=", ".join(type(part).__name__ for part in (algorithm.policy, algorithm.critic, algorithm.update)),
            notes=(*self._advice(exactly), *filter(None, [greedy_is_worse(deterministic, sampled)])),
        )

    def _advice(self, exactly: Mapping[str, float | None]) -> list[str]:
        """Advice that the policy hardly moved or has not converged, where that is so."""
        missing = stationary_gap = None
        if self.truth is not None:
            span = float(span_of(self.truth.optimum.q_SA.reshape(1, -1)))
            J, best, gap = (exactly[name] or 0.0 for name in ("J", "J_optimal", "stationarity_gap"))
            missing, stationary_gap = ((best - J) / span, gap / span) if span > 0 else (0.0, 0.0)
        advice = learned_little(
            self.movement,
            self.algorithm.update,
            depth=self._deepest,
            missing_share=missing,
            stationary_share=stationary_gap,
        )
        return [] if advice is None else [advice]


def _evaluations(config: EvalConfig, seed: int, folder: Folder) -> dict[str, EvalCallback]:
    """The evaluations during training; the deterministic one picks the best model and may end the training."""
    if config.every is None:
        return {}
    shared: dict[str, Any] = {"every": config.every, "episodes": config.episodes, "seed": seed}
    best_path = folder.path / BEST_FILE if config.keep_best else None
    greedy = EvalCallback(**shared, best_path=best_path, stop_at_return=config.stop_at_return)
    return {"deterministic": greedy, "sampled": EvalCallback(**shared, deterministic=False)}

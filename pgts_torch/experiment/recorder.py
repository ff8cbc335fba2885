"""What a run does between iterations: log, evaluate, save; and at its end, sum up."""

import copy
import math
import time
from pathlib import Path
from typing import Any

from pgts_torch.agent.board import is_drawn
from pgts_torch.agent.callbacks import EvalCallback
from pgts_torch.agent.certificate import CONFIDENCE
from pgts_torch.agent.diagnostics import Diagnostics
from pgts_torch.agent.evaluate import Evaluator
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.agent.states import load_checked
from pgts_torch.config import Config
from pgts_torch.config.config import EvalConfig
from pgts_torch.experiment import checkpoint
from pgts_torch.experiment.advice import Movement, greedy_is_worse, learned_little, span_of
from pgts_torch.experiment.checkpoint import Notes, Progress
from pgts_torch.experiment.evaluate import KINDS
from pgts_torch.experiment.ownership import BEST_FILE
from pgts_torch.experiment.progress import Reporter
from pgts_torch.experiment.resume import Start, plain
from pgts_torch.experiment.signals import StopFlag
from pgts_torch.experiment.summary import Summary, results
from pgts_torch.experiment.tracking import RunFolder, versions
from pgts_torch.tabular import exact, stationary

MOST_SECONDS = 60
"""The most seconds between two checkpoints, up to one iteration."""


class Recorder:
    """The callback of a run: logs, evaluates and saves after each iteration.

    The logged metrics describe the policy that collected the episodes, which is the one before the update.

    Args:
        folder: None: another process writes.
    """

    def __init__(
        self,
        config: Config,
        algorithm: PGTS,
        path: Path,
        folder: RunFolder | None,
        stop: StopFlag,
        movement: Movement,
    ) -> None:
        self.config, self.algorithm, self.path, self.folder, self.stop = config, algorithm, path, folder, stop
        self.movement = movement
        movement.before = copy.deepcopy(algorithm.policy)
        self.progress = Progress()
        total_steps, log = config.total_steps, config.log
        self.diagnostics = Diagnostics(
            algorithm.parts, total_steps=total_steps, every=log.every, points=log.exact_points
        )
        self.report = Reporter(config.total_steps, shown=folder is not None)
        self._last: Iteration | None = None
        self._clock = time.perf_counter()
        self._started = self._saved_clock = self._clock
        self._saved_at = -1
        self._evaluator = Evaluator(config.eval.episodes)
        self._evaluations = _evaluations(config.eval, algorithm.seed, path, self._evaluator)

    @property
    def finished(self) -> bool:
        """Whether the training is complete, not only interrupted."""
        return self.progress.ended_by is not None

    def __call__(self, algorithm: PGTS, iteration: Iteration) -> bool:
        """Log, evaluate and save; False ends the training."""
        seconds = time.perf_counter() - self._clock
        k, step, progress = algorithm.num_iterations, algorithm.num_env_steps, self.progress
        progress.depth = max(progress.depth, iteration.depth)
        if algorithm.posterior is None:
            progress.certificate = iteration.certificate if math.isfinite(iteration.certificate) else None
        elif iteration.posterior is not None:
            progress.certificate = iteration.posterior
        self._last = iteration
        self.movement.follow(algorithm, iteration)
        tags, spread = self.diagnostics(iteration, algorithm.counters, seconds)
        events = None if self.folder is None else self.folder.events
        if self.folder is not None and tags:
            self.folder.log(step, tags)
            self.report.line(step, tags)
        if events is not None and spread is not None:
            events.spread(step, spread)
        go_on = [evaluation(algorithm, iteration) for evaluation in self._evaluations.values()]
        scores = {tag: value for each in self._evaluations.values() for tag, value in each.tags(step).items()}
        if self.folder is not None and scores:
            self.folder.log(step, scores)
            every, total = self.config.eval.every, self.config.total_steps
            if events is not None and every and is_drawn(step, iteration.num_steps, every=every, total_steps=total):
                events.policy(step, algorithm.world.mdp, self.diagnostics.policy_table())
        if iteration.is_enough:
            progress.ended_by = "certificate"
        elif not all(go_on):
            progress.ended_by = "return"
        elif step >= self.config.total_steps:
            progress.ended_by = "total_steps"
        every = self.config.log.checkpoint_every
        is_late = lambda: time.perf_counter() - self._saved_clock > MOST_SECONDS  # noqa: E731
        is_due = every and (k % every == 0 or algorithm.ranks.first("the time", is_late))
        if is_due and not self.finished:  # the last one waits until the training has ended
            self.save()
        self._clock = time.perf_counter()
        return not self.finished and self.stop.signal is None

    def save(self) -> None:
        """Write a checkpoint, unless there is one of this step."""
        if self._saved_at == self.algorithm.num_env_steps:
            return
        if self._last is not None:
            self.movement.measure(self.algorithm, self._last)
        self.progress.seconds = time.perf_counter() - self._started
        self.progress.evaluations = {kind: each.state_dict() for kind, each in self._evaluations.items()}
        self.progress.movement = self.movement.state_dict()
        notes = Notes(
            iterations=self.algorithm.num_iterations,
            env_steps=self.algorithm.num_env_steps,
            model_calls=self.algorithm.num_model_calls,
            config=plain(self.config),
            versions=versions(),
            world_size=self.algorithm.ranks.size,
            files={} if self.folder is None else self.folder.flush(),
            progress=self.progress,
        )
        checkpoint.write(self.path, self.algorithm, notes, keep=self.config.log.keep)
        self._saved_at, self._saved_clock = self.algorithm.num_env_steps, time.perf_counter()

    def load(self, start: Start) -> None:
        """Resume from what `save` wrote; the algorithm itself is loaded already. PgtsError if it is something else."""
        self.progress = start.notes.progress
        self._started -= self.progress.seconds
        for kind, evaluation in self._evaluations.items():
            if (state := self.progress.evaluations.get(kind)) is not None:
                load_checked(f"progress.evaluations.{kind}", state, evaluation.load_state_dict, evaluation.state_dict)
        self.movement.load_state_dict(self.progress.movement)
        self._saved_at = start.notes.env_steps
        if start.lost_best:
            best = self._evaluations["deterministic"]
            best.reset()
            assert best.best_path is not None
            self.algorithm.save(best.best_path)

    def finish(self) -> Summary:
        """Draw the policy and summarise the run."""
        seconds = time.perf_counter() - self._started
        config, algorithm, depth = self.config, self.algorithm, self.progress.depth
        J = J_optimal = gap = missing = stationary_gap = None
        assert self.progress.ended_by is not None
        if (truth := self.diagnostics.truth) is not None and self.folder is not None:
            from pgts_torch.experiment.pictures import policy_picture  # matplotlib, a fifth of what a start takes

            pi_SA = algorithm.policy_table()
            title = f"{config.env.id}, depth {config.search.depth}, seed {config.seed}"
            self.folder.picture("policy", policy_picture(algorithm.mdp, pi_SA, title=title), algorithm.num_env_steps)
            J, J_optimal = exact.evaluate(algorithm.mdp, pi_SA).J, truth.optimum.J
            gap = float(stationary.gap(algorithm.mdp, pi_SA, depth).max())
            span = float(span_of(truth.optimum.q_SA.reshape(1, -1)))
            missing, stationary_gap = ((J_optimal - J) / span, gap / span) if span > 0 else (0.0, 0.0)
        deterministic, sampled = (
            self._evaluator(algorithm, deterministic=kind, seed=algorithm.seed) for kind in KINDS.values()
        )
        self._evaluator.close()
        advice = [
            learned_little(
                self.movement, algorithm.update, depth=depth, missing_share=missing, stationary_share=stationary_gap
            ),
            greedy_is_worse(deterministic, sampled),
        ]
        summary = Summary(
            run=str(self.path),
            seed=algorithm.seed,
            depth=depth,
            search="none" if algorithm.search is None else str(algorithm.search),
            J=J,
            J_optimal=J_optimal,
            stationarity_gap=gap,
            **self._certified(),
            gap_bound=None if self._last is None or math.isinf(self._last.gap_bound) else self._last.gap_bound,
            ended_by=self.progress.ended_by,
            iterations=algorithm.num_iterations,
            env_steps=algorithm.num_env_steps,
            model_calls=algorithm.num_model_calls,
            seconds=seconds,
            deterministic=deterministic,
            sampled=sampled,
            parts=", ".join(type(part).__name__ for part in (algorithm.policy, algorithm.critic, algorithm.update)),
            notes=tuple(filter(None, advice)),
        )
        if self.folder is not None and self.folder.events is not None:
            self.folder.events.end(algorithm.num_env_steps, results(summary))
        return summary

    def _certified(self) -> dict[str, Any]:
        """The certificate's fields of the summary. A proof, and one from counts, is made again for the policy after its
        last update."""
        algorithm, bound = self.algorithm, self.progress.certificate
        certificates, posterior = algorithm.certificates, algorithm.posterior
        was_reached = self.progress.ended_by == "certificate"  # then the policy was kept, and all ranks know the bound
        if posterior is not None:
            bound = bound if was_reached else posterior.now()
            trust, confidence = "posterior", posterior.level
        elif certificates is not None:
            trust, confidence = certificates.trust, CONFIDENCE if certificates.trust == "sampled starts" else 1.0
            if trust == "proved":
                proof = certificates.of(algorithm.policy_table())
                proof = proof if bound is None or not was_reached else min(proof, bound)
                bound = proof if math.isfinite(proof) else None
        if bound is None:
            return {}
        return {"certificate": bound, "certificate_trust": trust, "certificate_confidence": confidence}


def _evaluations(config: EvalConfig, seed: int, run: Path, evaluator: Evaluator) -> dict[str, EvalCallback]:
    """The evaluations during training; the deterministic one picks the best model and may end the training."""
    if config.every is None:
        return {}
    shared: dict[str, Any] = {"every": config.every, "seed": seed, "evaluator": evaluator}
    best_path = run / BEST_FILE if config.keep_best else None
    greedy = EvalCallback(**shared, best_path=best_path, stop_at_return=config.stop_at_return)
    return {"deterministic": greedy, "sampled": EvalCallback(**shared, deterministic=False)}

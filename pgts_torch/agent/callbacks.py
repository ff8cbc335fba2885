"""Callbacks of `PGTS.learn`: evaluation during training, early stop, and the best model."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from pgts_torch.agent import saving
from pgts_torch.agent.evaluate import Evaluation, Evaluator, Score
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError, check_count


@dataclass(frozen=True)
class Evaluated:
    """An evaluation during training, after `env_steps` environment steps."""

    env_steps: int
    evaluation: Evaluation

    @property
    def mean(self) -> float:
        """The mean undiscounted return of its episodes."""
        return self.evaluation.episodic_return.mean


@final
class EvalCallback:
    """Evaluates the policy every so many environment steps, in environments of its own: training is not affected.

    It evaluates after each iteration in which the number of environment steps passes a multiple of `every`.

    Args:
        every: environment steps from one evaluation to the next; after a longer iteration there is one evaluation.
        episodes: of one evaluation.
        deterministic: take the most probable action; else sample from pi.
        seed: of the episodes, the same in all evaluations, so that they differ by the policy alone.
        best_path: where the model is saved whenever the mean return is the highest so far; None: nowhere.
        stop_at_return: training ends once the mean return is at least this; None: it does not.
        evaluator: what evaluates, with a number of episodes of its own, where several share the environments. They stay
            open until it is closed. Default: one for this callback.

    Raises:
        PgtsError: an option out of range, or a file at `best_path` that is no saved model.

    Attributes:
        history: the evaluations so far.
        best: the first one with the highest mean return; None before the first.
    """

    def __init__(
        self,
        *,
        every: int,
        episodes: int = 10,
        deterministic: bool = True,
        seed: int = 0,
        best_path: str | Path | None = None,
        stop_at_return: float | None = None,
        evaluator: Evaluator | None = None,
    ) -> None:
        check_count("every", every)
        if stop_at_return is not None and not math.isfinite(stop_at_return):
            raise PgtsError(f"stop_at_return is {stop_at_return}; it must be finite")
        if best_path is not None:
            saving.target(best_path)
        self.every, self.deterministic, self.seed = every, deterministic, seed
        self.evaluator = evaluator or Evaluator(episodes)
        self.best_path, self.stop_at_return = best_path, stop_at_return
        self.history: list[Evaluated] = []
        self.best: Evaluated | None = None

    def __call__(self, algorithm: PGTS, iteration: Iteration) -> bool:
        """Evaluate if it is due. Return whether training goes on."""
        now = algorithm.num_env_steps
        if now // self.every == (now - iteration.num_steps) // self.every:
            return True
        evaluation = algorithm.ranks.first(
            "an evaluation",
            lambda: self.evaluator(algorithm, deterministic=self.deterministic, seed=self.seed),
        )
        latest = Evaluated(now, evaluation)
        self.history.append(latest)
        if algorithm.board is not None:
            algorithm.board.evaluated(self.tags(now), every=self.every)
        if self.best is None or latest.mean > self.best.mean:
            self.best = latest
            if self.best_path is not None:
                algorithm.save(self.best_path)
        return self.stop_at_return is None or latest.mean < self.stop_at_return

    def tags(self, step: int) -> dict[str, float]:
        """Return what is logged of the evaluation that was made at this step; nothing if there was none."""
        if not self.history or self.history[-1].env_steps != step:
            return {}
        tags, kind = {}, "deterministic" if self.deterministic else "sampled"
        for name in ("episodic_return", "episodic_length"):
            score: Score = getattr(self.history[-1].evaluation, name)
            short = name.removeprefix("episodic_")
            tags[f"eval/{kind}_{short}"] = score.mean
            if score.half_width is not None:
                tags[f"eval/{kind}_{short}_half_width"] = score.half_width
        return tags

    def reset(self) -> None:
        """Remove all evaluations so far, so that the next one is the best."""
        self.history, self.best = [], None

    def state_dict(self) -> dict[str, Any]:
        """Return the evaluations so far, as plain values."""
        return {"history": [asdict(evaluated) for evaluated in self.history]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Load what `state_dict` returned."""
        for saved in state["history"]:
            check_count("env_steps", saved["env_steps"])
        self.history = [Evaluated(saved["env_steps"], _evaluation(**saved["evaluation"])) for saved in state["history"]]
        self.best = max(self.history, key=lambda evaluated: evaluated.mean, default=None)


def _evaluation(episodes: int, **saved: Mapping[str, Any]) -> Evaluation:
    check_count("episodes", episodes)
    scores = {name: Score(**score) for name, score in saved.items()}
    if not all(isinstance(score.mean, float) for score in scores.values()):
        raise PgtsError("a mean is no number")
    return Evaluation(episodes, scores["episodic_return"], scores["discounted_return"], scores["episodic_length"])

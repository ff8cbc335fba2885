"""What `PGTS.learn` can be told to do after its iterations."""

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, final

from pgts_torch.agent import saving
from pgts_torch.agent.evaluate import Evaluation, Score, evaluate
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.pgts import PGTS
from pgts_torch.errors import PgtsError, check_count


@dataclass(frozen=True)
class Evaluated:
    """An evaluation, and the environment steps of training before it."""

    env_steps: int
    evaluation: Evaluation

    @property
    def mean(self) -> float:
        """The mean return of its episodes, undiscounted."""
        return self.evaluation.episodic_return.mean


@final
class EvalCallback:
    """Evaluates the policy now and then, in copies of its own: training goes on as if it had not been there.

    It does so after an iteration that completes another `every` environment steps since the training began.

    Args:
        every: environment steps from one evaluation to the next; an iteration that makes more is followed by one.
        episodes: of one evaluation.
        deterministic: take the most probable action, else draw from pi.
        seed: of the episodes, the same in all evaluations: they differ by the policy alone.
        best_path: where the model is saved whenever the mean return is higher than ever; None: nowhere.
        stop_at_return: the training ends once the mean return is at least this; None: it does not.

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
    ) -> None:
        check_count("every", every)
        check_count("episodes", episodes)
        if stop_at_return is not None and not math.isfinite(stop_at_return):
            raise PgtsError(f"stop_at_return is {stop_at_return}; it must be finite")
        if best_path is not None:
            saving.target(best_path)
        self.every, self.episodes, self.deterministic, self.seed = every, episodes, deterministic, seed
        self.best_path, self.stop_at_return = best_path, stop_at_return
        self.history: list[Evaluated] = []
        self.best: Evaluated | None = None

    def __call__(self, algorithm: PGTS, iteration: Iteration) -> bool:
        """Whether training may go on."""
        now = algorithm.num_env_steps
        if now // self.every == (now - iteration.experience.num_steps) // self.every:
            return True
        evaluation = algorithm.ranks.first("an evaluation", lambda: self._evaluated(algorithm))
        latest = Evaluated(now, evaluation)
        self.history.append(latest)
        if self.best is None or latest.mean > self.best.mean:
            self.best = latest
            if self.best_path is not None:
                algorithm.save(self.best_path)
        return self.stop_at_return is None or latest.mean < self.stop_at_return

    def _evaluated(self, algorithm: PGTS) -> Evaluation:
        return evaluate(algorithm, episodes=self.episodes, deterministic=self.deterministic, seed=self.seed)

    def forget(self) -> None:
        """All evaluations so far: the next one is the best."""
        self.history, self.best = [], None

    def state_dict(self) -> dict[str, Any]:
        """The evaluations so far, as plain values."""
        return {"history": [asdict(made) for made in self.history]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        for made in state["history"]:
            check_count("env_steps", made["env_steps"])
        self.history = [Evaluated(made["env_steps"], _evaluation(**made["evaluation"])) for made in state["history"]]
        self.best = max(self.history, key=lambda made: made.mean, default=None)


def _evaluation(episodes: int, **scores: Mapping[str, Any]) -> Evaluation:
    check_count("episodes", episodes)
    made = {name: Score(**score) for name, score in scores.items()}
    if not all(isinstance(score.mean, float) for score in made.values()):
        raise PgtsError("a mean is no number")
    return Evaluation(episodes, made["episodic_return"], made["discounted_return"], made["episodic_length"])

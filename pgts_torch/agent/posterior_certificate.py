"""Certificates of the trained policy from what a learned table has counted."""

import math
from typing import Any, final

import torch

from pgts_torch.agent.policies import Policy, exact_probs
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.states import check_keys
from pgts_torch.errors import PgtsError
from pgts_torch.models.counts import CountsModel
from pgts_torch.models.posterior import posterior_certificate
from pgts_torch.seeding import stream

_GROWTH = 1.1
"""A certificate is made whenever the number of steps has passed another power of this."""


@final
class PosteriorCertificate:
    """An upper bound on J* - J^pi with a posterior probability, `posterior_certificate`, of the policy that is trained.

    The start distribution is estimated from the episodes that have begun so far.

    start_count_S: how many of them have begun in each state.

    Args:
        model: the table; `Counts.certificate` of its options is the probability.
        seed: the tables are sampled from streams of their own, so that no training changes for them.
    """

    def __init__(self, model: CountsModel, policy: Policy, *, seed: int) -> None:
        level = model.options.certificate
        assert level is not None
        self.level, self._model, self._policy, self._seed = level, model, policy, seed
        self.start_count_S = torch.zeros(model.num_states, dtype=torch.int64)

    def follow(self, experience: Rollout, steps_before: int) -> float | None:
        """Count where episodes have begun; return `now` where it is due after them, else None."""
        [start_B] = experience.ranks.rows("first states", experience.start_state_N.cpu())
        starts, count_N = start_B.unique(return_counts=True)
        self.start_count_S[starts] += count_N
        powers = [int(math.log(max(n, 1), _GROWTH)) for n in (steps_before, steps_before + experience.share.total)]
        return self.now() if steps_before == 0 or powers[0] < powers[1] else None

    def now(self) -> float:
        """The bound for the policy as it is, from all steps that were learned from."""
        S, num_starts = len(self.start_count_S), int(self.start_count_S.sum())
        return posterior_certificate(
            self._model,
            exact_probs(self._policy, torch.arange(S, device=self._model.device)),
            self.start_count_S / num_starts,
            num_starts=num_starts,
            level=self.level,
            generator=stream(self._seed, "certificate", num_starts),
        )

    def state_dict(self) -> dict[str, Any]:
        """How many episodes have begun in each state."""
        return {"start_count": self.start_count_S.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError if it is something else."""
        check_keys("the state of a certificate", state, {"start_count"})
        count_S, own_S = state["start_count"], self.start_count_S
        if (count_S.dtype, count_S.shape) != (own_S.dtype, own_S.shape) or bool((count_S < 0).any()):
            raise PgtsError(f"start_count is no count of each of the {len(own_S)} states")
        self.start_count_S = count_S.clone()

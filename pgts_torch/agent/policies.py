"""Policies: a distribution over actions for each observation; here tables, whose observations are states."""

import math
from abc import ABC, abstractmethod
from typing import Any, final

import torch
from jaxtyping import Bool, Float, Int, Num
from torch import Tensor

from pgts_torch.agent.components import legal_only
from pgts_torch.errors import NotFinite, PgtsError
from pgts_torch.options.policies import Biased, Init, Random, Simplex, Softmax, Uniform
from pgts_torch.seeding import stream


def initial(
    init: Init,
    num_states: int,
    num_actions: int,
    generator: torch.Generator,
    legal_SA: Bool[Tensor, "S A"] | None = None,
) -> Float[Tensor, "S A"]:
    """Return the probabilities of the initial policy.

    `Biased(action=0, probability=1)` on the Ladder is the paper's "always left".

    Args:
        legal_SA: the actions that are allowed, over which each row is; None: all are. Where these have probability 0
            together it is uniform over them.
    """
    probs_SA = _initial(init, num_states, num_actions, generator)
    if legal_SA is None:
        return probs_SA
    legal_SA = legal_SA.to(probs_SA)
    kept_SA = probs_SA * legal_SA
    kept_SA = torch.where(kept_SA.sum(-1, keepdim=True) > 0, kept_SA, legal_SA)
    return kept_SA / kept_SA.sum(-1, keepdim=True)


def _initial(init: Init, num_states: int, num_actions: int, generator: torch.Generator) -> Float[Tensor, "S A"]:
    """The same where all actions are allowed."""
    if isinstance(init, Biased) and init.action >= num_actions:
        raise PgtsError(f"policy.init.action is {init.action}; actions are 0 to {num_actions - 1}")
    if isinstance(init, Uniform) or num_actions == 1:
        return torch.full((num_states, num_actions), 1 / num_actions, dtype=torch.float64)
    if isinstance(init, Random):
        uniform_SA = torch.rand(num_states, num_actions, generator=generator, dtype=torch.float64)
        exponential_SA = -torch.log1p(-uniform_SA).clamp(max=-1e-12)
        return exponential_SA / exponential_SA.sum(-1, keepdim=True)
    rest = (1 - init.probability) / (num_actions - 1)
    probs_SA = torch.full((num_states, num_actions), rest, dtype=torch.float64)
    probs_SA[:, init.action] = init.probability
    return probs_SA


class Policy(ABC):
    """pi(a|o) for observations o: states of a tabular world, else vectors or images.

    options: what it was made from; None for a policy of the caller's own class.
    """

    num_actions: int
    options: Any = None

    @abstractmethod
    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        """pi(.|o) for each observation, without gradient."""

    @abstractmethod
    def state_dict(self) -> dict[str, Any]:
        """Return the parameters, as tensors on the CPU and plain values."""

    @abstractmethod
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load parameters of the same shape; PgtsError if they do not fit."""

    def sample(self, observation_N: Tensor, *, generator: torch.Generator) -> Num[Tensor, "N ..."]:
        """Sample one action for each observation; NotFinite where a probability is not finite."""
        return drawn(self.probs(observation_N), generator=generator)


def drawn(pi_NA: Float[Tensor, "N A"], *, generator: torch.Generator) -> Int[Tensor, "N"]:
    """Sample one action from each row of weights, which need not add up to 1.

    It is the action with the largest pi(a|o) / E_a for exponentially distributed E_a, as in `torch.multinomial`, which
    takes five times as long because it checks its probabilities.
    """
    score_N, action_N = (pi_NA / torch.empty_like(pi_NA).exponential_(generator=generator)).max(-1)
    if not math.isfinite(score_N.sum()):
        off_N = score_N.isnan() | ~pi_NA.isfinite().all(-1)
        if bool(off_N.any()):
            raise NotFinite(f"the policy's probabilities are {pi_NA[off_N][0].tolist()}", what="probability")
    return action_N


class TabularPolicy(Policy):
    """pi(a|s) over numbered states, in float64.

    Args:
        legal_SA: the actions that are allowed; None: all are. The others have probability 0.
    """

    def __init__(
        self,
        num_states: int,
        num_actions: int,
        options: Any = None,
        *,
        legal_SA: Bool[Tensor, "S A"] | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
    ) -> None:
        self.options = options = self.options if options is None else options
        self.num_states, self.num_actions = num_states, num_actions
        self._legal_SA = None if legal_SA is None else legal_SA.to(device)
        self._begin(initial(options.init, num_states, num_actions, stream(seed, "policy"), legal_SA), device)

    @abstractmethod
    def _begin(self, probs_SA: Float[Tensor, "S A"], device: torch.device | str) -> None:
        """Take over the initial probabilities, which are on the CPU."""

    def table(self) -> Float[Tensor, "S A"]:
        """pi(.|s) for all states, on the CPU."""
        return self.probs(torch.arange(self.num_states)).cpu()


@final
class SoftmaxPolicy(TabularPolicy):
    """pi(a|s) ~ exp(logits[s, a]): every action that is allowed keeps a positive probability."""

    options: Softmax = Softmax()

    def _begin(self, probs_SA: Float[Tensor, "S A"], device: torch.device | str) -> None:
        self.logits_SA = probs_SA.log().to(device)

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        return self.logits_SA[observation_N].softmax(-1)

    def state_dict(self) -> dict[str, Any]:
        """Return the logits, 0 in place of -inf."""
        return {"logits_SA": legal_only(self.logits_SA, self._legal_SA, 0.0).cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.logits_SA = legal_only(fitting(state, "logits_SA", self.logits_SA), self._legal_SA)


@final
class SimplexPolicy(TabularPolicy):
    """The paper's direct parametrisation: pi(a|s) is the parameter itself, and may be 0 or 1.        [PGTS Sec. 2]"""

    options: Simplex = Simplex()

    def _begin(self, probs_SA: Float[Tensor, "S A"], device: torch.device | str) -> None:
        self.probs_SA = probs_SA.to(device)

    def probs(self, observation_N: Tensor) -> Float[Tensor, "N A"]:
        return self.probs_SA[observation_N]

    def state_dict(self) -> dict[str, Any]:
        return {"probs_SA": self.probs_SA.cpu().clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        probs_SA = fitting(state, "probs_SA", self.probs_SA)
        if not bool((probs_SA >= 0).all() and ((probs_SA.sum(-1) - 1).abs() <= 1e-6).all()):
            raise PgtsError("probs_SA has rows that are no distributions")
        self.probs_SA = probs_SA


def exact_probs(policy: Policy, observation_S: Tensor) -> Float[Tensor, "S A"]:
    """pi(.|o) on the CPU in float64; probabilities of float32 are divided by their sum."""
    pi_SA = policy.probs(observation_S).cpu()
    return pi_SA if pi_SA.dtype == torch.float64 else pi_SA.double() / pi_SA.double().sum(-1, keepdim=True)


def fitting(state: dict[str, Any], name: str, like: Tensor) -> Tensor:
    """Return a copy of state[name] on the device of `like`; PgtsError unless it is a tensor of its shape and dtype."""
    value = state.get(name)
    if not isinstance(value, Tensor) or value.shape != like.shape or value.dtype != like.dtype:
        found = f"{value.dtype} of shape {tuple(value.shape)}" if isinstance(value, Tensor) else value
        raise PgtsError(f"{name} is {found}; a tensor of {like.dtype} of shape {tuple(like.shape)} is needed")
    return value.to(like, copy=True)  # because updates write in place

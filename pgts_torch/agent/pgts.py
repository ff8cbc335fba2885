"""Policy gradient with tree search, from rollouts.        [PGTS Alg. 1]"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self, final

import numpy as np
import torch
from gymnasium.vector import VectorEnv
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor
from tqdm import tqdm

from pgts_torch.agent import saving
from pgts_torch.agent.build import Description, make_critic, make_horizon, make_policy, make_update
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.policies import Policy, SimplexPolicy
from pgts_torch.agent.rollout import Horizon, Rollout, check_vector_env, make_vector_env, rollout
from pgts_torch.agent.updates import Update
from pgts_torch.errors import PgtsError
from pgts_torch.models.tabular import TabularModel, tabular_truth
from pgts_torch.search.expectimax import expectimax
from pgts_torch.search.lookahead import MAX_NODES, Leaf, Lookahead
from pgts_torch.search.topology import Topology
from pgts_torch.seeding import stream
from pgts_torch.tabular.exact import check_depth

DEFAULT_GAMMA = 0.99
"""Discount of an environment that carries none."""

DEFAULT_MAX_DEPTH = 64
DEFAULT_TOLERANCE = 0.1


@dataclass(frozen=True, eq=False)
class Iteration:
    """What one pass through the loop of Algorithm 1 saw and did.

    experience: the episodes of pi_k.
    state_N, weight_N: the states it visited, and what each counted for in the update.
    pi_NA: pi_k at these states, before the update.
    depth: m.
    look: (T^m Q)(s, .) at these states.
    gap_N: max_a (T^m Q)(s, a) - v(s) >= 0, with v(s) = <pi(.|s), Q(s, .)> of the same critic.
    certificate: an upper bound on J* - J^pi; true if the critic is exact, else as far as its v is right at the start
        states. Infinite where the model knows no largest value.
    losses: the critic's, by name.
    model_calls: (state, action) asked of the model in this pass, by the lookahead and by the critic.
    """

    experience: Rollout
    state_N: Int[Tensor, "N"]
    weight_N: Float[Tensor, "N"]
    pi_NA: Float[Tensor, "N A"]
    depth: int
    look: Lookahead
    gap_N: Float[Tensor, "N"]
    certificate: float
    losses: dict[str, float]
    model_calls: int


Callback = Callable[["PGTS", Iteration], bool | None]
"""Called after each iteration; returning False ends the training."""


@final
class PGTS:
    """A policy that is pushed toward what a depth-m lookahead sees at the states it visits.

        pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d^pi(s) (T^m Q^pi)(s, .) ]        [PGTS Eq. (3)]

    The tree is used in training only; acting is one look into the policy. Everything random in iteration k is drawn
    from streams named by (seed, k), so a loaded model goes on exactly as the saved one would have.

    Args:
        env: a Gymnasium id with a tabular model behind it (pgts/*, or an environment with a P table), or copies of one
            as a VectorEnv that resets by mask.
        depth: m. 0 is plain policy gradient. "adaptive": in each iteration the smallest m at which the policy is far
            from stationary, because then it deserves no deeper look: sum_s d(s) g_m(s) > tolerance * certificate.
        max_depth: the largest m of an adaptive depth (default 64).
        tolerance: which share of what may be missing to J* a lookahead must see to be deep enough (default 0.1).
        stop_at: `learn` ends, with the policy in question, once the certificate proves J* - J^pi <= stop_at.
            Default: never.
        policy, critic, update, horizon: a part, or its description (`agent.build`): "softmax",
            {"type": "tabular", "target": "q"}, ...
        num_envs: episodes in each iteration.
        gamma: discount. Default: the environment's own (pgts/*), else 0.99. Copies of pgts/* bring their own.
        max_nodes: the most nodes of one lookahead.
        seed: of everything random.
        device: where policy, critic and model live.
        env_kwargs: for gymnasium.make, if the environment is given by its id.

    Raises:
        PgtsError: parts that do not fit each other, or options out of range.
        MissingModel: nothing that a lookahead could ask.
    """

    def __init__(
        self,
        env: str | VectorEnv,
        *,
        depth: int | Literal["adaptive"] = 4,
        max_depth: int | None = None,
        tolerance: float | None = None,
        stop_at: float | None = None,
        policy: Description | Policy = "softmax",
        critic: Description | Critic = "tabular",
        update: Description | Update | None = None,
        horizon: Description | Horizon = "fixed",
        num_envs: int = 32,
        gamma: float | None = None,
        max_nodes: int = MAX_NODES,
        seed: int = 0,
        device: torch.device | str = "cpu",
        env_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        self._arguments = {name: value for name, value in locals().items() if name != "self"}
        self.depths = _depths(depth, max_depth, tolerance)
        self.tolerance = DEFAULT_TOLERANCE if tolerance is None else tolerance
        if stop_at is not None and not 0 <= stop_at < math.inf:
            raise PgtsError(f"stop_at is {stop_at}; it must be finite and at least 0")
        self.stop_at = stop_at
        self.seed = seed
        self.max_nodes = max_nodes
        self.device = torch.device(device)
        self.env = self.make_copies(num_envs) if isinstance(env, str) else env
        check_vector_env(self.env)
        self.mdp = tabular_truth(self.env, gamma=DEFAULT_GAMMA if gamma is None else gamma)
        self.gamma = float(self.mdp.outcomes.discount_NAK.max())
        self.model = TabularModel(self.mdp, device=self.device)
        self.topology = Topology(self.model)
        S, A = self.mdp.num_states, self.mdp.num_actions
        if not isinstance(policy, Policy):
            policy = make_policy(policy, S, A, seed=seed, device=self.device)
        if not isinstance(critic, Critic):
            critic = make_critic(critic, self.model, self.mdp)
        if update is None:
            update = "projected" if isinstance(policy, SimplexPolicy) else "softmax"
        if not isinstance(update, Update):
            update = make_update(update)
        if not isinstance(horizon, Horizon):
            horizon = make_horizon(horizon)
        self.policy, self.critic, self.update, self.horizon = policy, critic, update, horizon
        self._check_parts()
        self.num_iterations = 0
        self.num_env_steps = 0
        self.num_model_calls = 0

    def _check_parts(self) -> None:
        """PgtsError where parts do not fit each other, or where an argument would have no effect."""
        self.update.check(self.policy)
        shape, found = (self.mdp.num_states, self.mdp.num_actions), (self.policy.num_states, self.policy.num_actions)
        if found != shape:
            raise PgtsError(f"the policy is one of (states, actions) = {found}; the environment has {shape}")
        if not isinstance(self._arguments["env"], str):
            gamma, env_kwargs = self._arguments["gamma"], self._arguments["env_kwargs"]
            if gamma not in (None, self.gamma):
                raise PgtsError(f"gamma is {gamma}; the given environment has its own, {self.gamma}")
            if env_kwargs:
                raise PgtsError(f"env_kwargs is {env_kwargs}; an environment that is given as an object takes none")

    def iterate(self) -> Iteration:
        """One pass through the loop: visit states, estimate Q^pi, look m steps ahead, move pi.        [PGTS Alg. 1]"""
        names = ("iteration", self.num_iterations)
        generator = stream(self.seed, *names, device=self.device)
        calls_before = self.topology.model_calls + self.critic.model_calls

        # Visit states with pi_k and estimate Q^{pi_k} (line 2).
        experience = rollout(
            self.env, self.policy, self.horizon, gamma=self.gamma, seed=self.seed, names=names, generator=generator
        )
        losses = self.critic.fit(self.policy, experience, generator=generator)

        # Look m steps ahead from the states with d(s) > 0.
        states, weight_N = experience.visits(self.update.state_weight)
        pi_NA = self.policy.probs(states)
        depth, look, gap_N, certificate = self._look(experience, states, pi_NA)

        # pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d(s) (T^m Q)(s, .) ] (line 3), unless pi_k is proved good enough.
        if not self._proved(certificate):
            self.update(self.policy, states, look.q_BA, weight_N)

        self.num_iterations += 1
        self.num_env_steps += experience.num_steps
        model_calls = self.topology.model_calls + self.critic.model_calls - calls_before
        self.num_model_calls += model_calls
        return Iteration(experience, states, weight_N, pi_NA, depth, look, gap_N, certificate, losses, model_calls)

    def _look(self, experience: Rollout, state_N: Tensor, pi_NA: Tensor) -> tuple[int, Lookahead, Tensor, float]:
        """The lookahead at the given depth, or at the first that sees enough, with its gap and certificate."""
        v_N = (pi_NA * self.lookahead(state_N, depth=0).q_BA).sum(-1)
        _, occupancy_N = experience.visits("occupancy")
        for depth in self.depths:
            look = self.lookahead(state_N, depth=depth)
            gap_N = (look.q_BA.amax(-1) - v_N).clamp(min=0)
            certificate = self._certificate(experience, state_N, v_N, depth)
            if float(gap_N @ occupancy_N) > self.tolerance * certificate or self._proved(certificate):
                break
        return depth, look, gap_N, certificate

    @property
    def env_id(self) -> str:
        """The environment's Gymnasium id; PgtsError if the environment was given as an object."""
        env_id = self._arguments["env"]
        if not isinstance(env_id, str):
            raise PgtsError(f"the environment was given as {env_id!r}; only one given by its id can be made again")
        return env_id

    def make_copies(self, num_envs: int) -> VectorEnv:
        """Fresh copies of the environment, without its time limit."""
        kwargs = self._arguments["env_kwargs"] or {}
        return make_vector_env(self.env_id, num_envs, gamma=self._arguments["gamma"], **kwargs)

    def lookahead(self, state_N: Int[Tensor, "N"], *, depth: int | None = None) -> Lookahead:
        """(T^m Q)(s, .) at the given states, with the critic's estimate of Q^pi or v^pi at the leaves.

        Args:
            depth: m; default the depth of the training, or its largest if it is adaptive.
        """
        depth = self.depths[-1] if depth is None else depth
        leaf = {"v_leaf": self.critic.v} if self.critic.target == "v" else {"q_leaf": self.critic.q}
        return self._search(state_N, depth, **leaf)

    def _search(self, state_N: Int[Tensor, "N"], depth: int, **leaf: Leaf) -> Lookahead:
        return expectimax(self.model, state_N, depth=depth, topology=self.topology, max_nodes=self.max_nodes, **leaf)

    def _certificate(self, experience: Rollout, state_N: Tensor, v_N: Tensor, depth: int) -> float:
        """J* - J^pi <= mean over starts of (T^n w)(s) - v(s), for w the highest value there can be; n is the number of
        levels that the lookahead has itself, so the model is asked nothing new.        [docs/theory.md, Prop. 5]"""
        starts, count_N = experience.state_TB[0].unique(return_counts=True)
        highest = torch.tensor(self.model.highest_value, dtype=torch.float64, device=self.device)
        upper_N = highest.expand(len(starts))
        expansions = depth + (self.critic.target == "v")
        if expansions and bool(highest.isfinite()):
            upper_N = self._search(starts, expansions - 1, v_leaf=lambda s: highest.expand(len(s))).q_BA.amax(-1)
        missing_N = upper_N - v_N[torch.searchsorted(state_N, starts)]
        return max(0.0, float(missing_N @ count_N.double() / experience.num_episodes))

    def _proved(self, certificate: float) -> bool:
        return self.stop_at is not None and certificate <= self.stop_at

    def learn(self, total_steps: int, *, callback: Callback | None = None, progress: bool = False) -> Self:
        """Iterate until `total_steps` environment steps have been made in all, counting those before this call.

        Args:
            callback: called with (self, iteration) after each iteration; returning False ends the training.
            progress: show a progress bar.
        """
        with tqdm(total=total_steps, initial=self.num_env_steps, unit="step", disable=not progress) as bar:
            while self.num_env_steps < total_steps:
                iteration = self.iterate()
                bar.update(iteration.experience.num_steps)
                if (callback is not None and callback(self, iteration) is False) or self._proved(iteration.certificate):
                    break
        return self

    def predict(
        self, observation: ArrayLike, *, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> np.ndarray | np.int64:
        """Actions for observations, one number for one state; no search.

        Args:
            observation: one state or an array of states, as integers.
            deterministic: the most probable action, else one drawn from pi.
            generator: for drawing; default a stream of this model's seed, the same in each call.
        """
        state = np.asarray(observation)
        if not np.issubdtype(state.dtype, np.integer):
            raise PgtsError(f"observation is of {state.dtype}; states are integers")
        off = state[(state < 0) | (state >= self.mdp.num_states)]
        if off.size:
            raise PgtsError(f"state {off[0]} does not exist; states are 0 to {self.mdp.num_states - 1}")
        state_N = torch.from_numpy(state.astype(np.int64).reshape(-1)).to(self.device)
        if deterministic:
            action_N = self.policy.probs(state_N).argmax(-1)
        else:
            generator = generator or stream(self.seed, "predict", device=self.device)
            action_N = self.policy.sample(state_N, generator=generator)
        return action_N.cpu().numpy().reshape(state.shape)[()]

    def save(self, path: str | Path) -> None:
        """Write everything that training or acting goes on from into one file with a checksum.

        Raises:
            PgtsError: the environment or a part was given as an object, so that no file can describe it, or an
                argument is no plain value.
        """
        plain = {**self._arguments, "device": str(self.device), "env_kwargs": dict(self._arguments["env_kwargs"] or {})}
        for name in ("env", "policy", "critic", "update", "horizon"):
            if not isinstance(plain[name], str | Mapping | None):
                raise PgtsError(f"{name} was given as {plain[name]!r}; only models made from descriptions can be saved")
        saving.write(path, {"arguments": plain, "state": self.state_dict()})

    @classmethod
    def load(cls, path: str | Path, *, device: torch.device | str | None = None) -> Self:
        """The model that `save` wrote; it trains on exactly as the saved one would have.

        Only the lookahead starts anew: it asks the model again for what it had seen, and `num_model_calls` counts that.

        Args:
            device: where to load it; default the device it was saved from.

        Raises:
            PgtsError: no such file, damaged, or not ours.
        """
        content = saving.read(path)
        if content.keys() != {"arguments", "state"}:
            raise PgtsError(f"{path} holds {sorted(map(str, content))}, not a model")
        arguments = content["arguments"] | ({} if device is None else {"device": str(device)})
        model = cls(**arguments)
        model.load_state_dict(content["state"])
        return model

    def state_dict(self) -> dict[str, Any]:
        """Policy, critic and counters, as tensors on the CPU and plain values."""
        return {
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "num_iterations": self.num_iterations,
            "num_env_steps": self.num_env_steps,
            "num_model_calls": self.num_model_calls,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave."""
        self.policy.load_state_dict(state["policy"])
        self.critic.load_state_dict(state["critic"])
        self.num_iterations = state["num_iterations"]
        self.num_env_steps = state["num_env_steps"]
        self.num_model_calls = state["num_model_calls"]


def _depths(depth: int | Literal["adaptive"], max_depth: int | None, tolerance: float | None) -> Sequence[int]:
    """The depths that an iteration tries, in order; PgtsError where an argument is out of range or has no effect."""
    if depth != "adaptive":
        for name, value in (("max_depth", max_depth), ("tolerance", tolerance)):
            if value is not None:
                raise PgtsError(f"{name} is {value}, which only depth='adaptive' heeds; depth is {depth}")
        return (check_depth(depth),)
    if tolerance is not None and not 0 <= tolerance < math.inf:
        raise PgtsError(f"tolerance is {tolerance}; it must be finite and at least 0")
    return range(check_depth(DEFAULT_MAX_DEPTH if max_depth is None else max_depth) + 1)

"""Policy gradient with tree search, from rollouts.        [PGTS Alg. 1]"""

import math
from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import Any, Literal, NamedTuple, Self, final

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor
from tqdm import tqdm

from pgts_torch.agent import saving
from pgts_torch.agent.advantages import LookaheadAdvantages, SampledAdvantages, score_function
from pgts_torch.agent.build import (
    DEFAULT_TOLERANCE,
    Description,
    check_parts,
    described,
    make_critic,
    make_depths,
    make_device,
    make_estimator,
    make_horizon,
    make_policy,
    make_search,
    make_update,
)
from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.iteration import Iteration, PolicyBatch
from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.model_check import Mode, ModelCheck
from pgts_torch.agent.policies import Policy, listed
from pgts_torch.agent.ranks import checksum, present_ranks
from pgts_torch.agent.rollout import Horizon, Rollout, rollout
from pgts_torch.agent.sharing import whole_lookahead, whole_rollout
from pgts_torch.agent.states import NO_STATE, check_keys, take_over
from pgts_torch.agent.updates import Update
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.environments import EnvSource, Given
from pgts_torch.models.rewards import RewardRange
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Leaf, Lookahead, check_finite
from pgts_torch.seeding import SharedGenerators, stream
from pgts_torch.tabular.ascent import centred
from pgts_torch.tabular.mdp import TabularMDP
from pgts_torch.trust import check_imports

Callback = Callable[["PGTS", Iteration], bool | None]
"""Called after each iteration; returning False ends the training. `agent.callbacks` has some."""

_ROUNDINGS = 16
"""So many roundings of the largest lookahead value make a difference that means nothing."""


class _Draws(NamedTuple):
    """What an iteration draws from: for its own part of the work, and for what all processes do alike."""

    own: torch.Generator
    common: torch.Generator


@final
class PGTS:
    """A policy that is pushed toward what a depth-m lookahead sees at the states it visits.

        pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d^pi(s) (T^m Q^pi)(s, .) ]        [PGTS Eq. (3)]

    The tree is used in training only; acting is one look into the policy. Everything random in iteration k is drawn
    from streams named by (seed, k), so a loaded model goes on exactly as the saved one would have.

    Where torch.distributed has a default process group, its processes train one policy together: each makes its part of
    the episodes and of the lookahead, and all make the same update from the whole batch (`agent.ranks`). They must make
    the same calls, with the same arguments.

    Args:
        env: a Gymnasium id; a spec; an instance, of whose spec others are made, which have to be like it; a function
            that makes one; or several as a VectorEnv that resets by mask (`EnvSource`). What a lookahead queries is
            the environment's table (pgts/*, or a P table), else its dynamics in torch (CartPole, Acrobot, MountainCar,
            Pendulum), else a simulator that is restored from snapshots.
        depth: m. 0 is plain policy gradient. "adaptive": in each iteration the smallest m at which the policy is far
            from stationary, because then it deserves no deeper look: sum_s d(s) g_m(s) >
            tolerance * sum_s d(s) (v_hat(s) - v(s)), where v_hat >= v* is that of the certificate.
        max_depth: the largest m of an adaptive depth (default 64).
        tolerance: which share of what may be missing to J* a lookahead must see to be deep enough (default 0.7).
        stop_at: `learn` ends, with the policy in question, once the certificate says J* - J^pi <= stop_at. That is a
            proof only where `certificates.trust` says so. Default: never.
        search: how the lookahead is made (`search.engine`): "auto", {"type": "sampled", "samples": 8},
            {"type": "mcts", "rule": "puct", "prior": "policy"}, ...
        estimator: "lookahead", or {"type": "sampled", "lambda": 0.95}: advantages of the actions taken, as in PPO and
            A2C, which need depth 0, a network and no model.
        policy, critic, update, horizon: a part, or its description (`agent.build`): "softmax", "mlp",
            {"type": "tabular", "target": "q"}, ... Default: tables where the environment is tabular, else networks.
        num_envs: episodes in each iteration, of all processes together; a VectorEnv belongs to this one alone and
            keeps its own number.
        actions_per_dimension: into how many evenly spaced values, from the lowest to the highest, each dimension of
            continuous actions is divided; None: actions are discrete, of MultiDiscrete each combination of them.
        model_check: each step of the environment is held to its model (`ModelCheck`). "error": the first contradiction
            stops the training before the policy is moved by it. "warn": it is said, once for each kind, and counted.
            "off": nobody looks.
        action_repeat: how often the lookahead takes an action before it takes the next, so that it sees as many times
            further at the same depth (`TensorModel` says what T^m Q is then); not in tables. Experience, and the
            policy, take single actions.
        observation_key: which part of dictionary observations policy and critic see.
        reward_range: the lowest and the highest reward of a single step, to which environment and model are held.
            `stop_at` and an adaptive depth need it where the model knows no largest reward (simulators).
        gamma: discount. Default: the environment's own (pgts/*), else 0.99. A VectorEnv of pgts/* brings its own.
        seed: of everything random.
        device: where policy, critic and model live.
        env_kwargs: for gymnasium.make, if the environment is given by its id.

    Raises:
        PgtsError: parts that do not fit each other, or options out of range.
        MissingModel: nothing that a lookahead could ask.
        ModelMismatch: rewards of a table are outside `reward_range`.
    """

    @torch.inference_mode(False)
    @torch.enable_grad()
    def __init__(
        self,
        env: Given,
        *,
        depth: int | Literal["adaptive"] = 4,
        max_depth: int | None = None,
        tolerance: float | None = None,
        stop_at: float | None = None,
        search: Description = "auto",
        estimator: Description = "lookahead",
        policy: Description | Policy | None = None,
        critic: Description | Critic | None = None,
        update: Description | Update | None = None,
        horizon: Description | Horizon = "fixed",
        num_envs: int = 32,
        actions_per_dimension: int | None = None,
        action_repeat: int = 1,
        model_check: Mode = "error",
        observation_key: str | None = None,
        reward_range: Sequence[float] | None = None,
        gamma: float | None = None,
        seed: int = 0,
        device: torch.device | str = "cpu",
        env_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        given = {name: value for name, value in locals().items() if name != "self"}
        self._arguments = {
            name: value.item() if isinstance(value, np.generic) else value for name, value in given.items()
        }
        self.depths = make_depths(depth, max_depth, tolerance)
        self.tolerance = DEFAULT_TOLERANCE if tolerance is None else tolerance
        if stop_at is not None and not 0 <= stop_at < math.inf:
            raise PgtsError(f"stop_at is {stop_at}; it must be finite and at least 0")
        self.stop_at = stop_at
        self.seed = seed
        self.device = make_device(device)
        self.estimator = make_estimator(estimator)
        self.ranks = present_ranks()
        num_envs = self._arguments["num_envs"]
        check_count("num_envs", num_envs)
        with SharedGenerators(seed, "construction"):
            self.source = EnvSource.of(env, kwargs=env_kwargs, gamma=gamma, actions_per_dimension=actions_per_dimension)
            if num_envs < self.ranks.size and self.source.given is None:
                raise PgtsError(f"num_envs is {num_envs}; {self.ranks.size} ranks need at least as many")
            self.world = make_world(
                self.source,
                num_envs=self.ranks.count(num_envs),
                gamma=gamma,
                observation_key=observation_key,
                plain=isinstance(self.estimator, SampledAdvantages),
                action_repeat=action_repeat,
                device=device,
            )
        self._arguments["env"] = self.source.description
        if reward_range is not None:
            self.world.promise(RewardRange.of(reward_range))
        if not isinstance(policy, Policy):
            policy = make_policy(policy, self.world, seed=seed)
        if not isinstance(critic, Critic):
            critic = make_critic(critic, self.world, policy, self.estimator, seed=seed)
        if not isinstance(update, Update):
            update = make_update(update, policy, self.estimator)
        if not isinstance(horizon, Horizon):
            horizon = make_horizon(horizon)
        self.policy, self.critic, self.update, self.horizon = policy, critic, update, horizon
        self.search: Search | None = None
        if isinstance(self.estimator, LookaheadAdvantages):
            self.search = make_search(search, self.world)
        self.certificates: Certificates | None = None
        if self.search is not None:
            assert isinstance(self.world, ModelWorld)
            self.certificates = Certificates(
                self.world, self.search, self.critic, num_depths=len(self.depths), ranks=self.ranks
            )
            if stop_at is not None:
                self.certificates.check(f"stop_at is {stop_at}")
            if depth == "adaptive":
                self.certificates.check("depth is adaptive")
        is_asked = self.search is not None
        self.model_check = ModelCheck(self.world, mode=model_check, is_asked=is_asked, seed=seed, ranks=self.ranks)
        check_parts(self._arguments, self.world, self.policy, self.critic, self.update, self.estimator)
        self._own_actions = self.source.own_actions(self.world.env)
        self._predicting = stream(seed, "predict", device=self.device)
        self.num_iterations = 0
        self.num_env_steps = 0
        self.num_model_calls = 0

    @torch.inference_mode(False)
    @torch.enable_grad()
    def iterate(self) -> Iteration:
        """One pass through the loop: visit states, estimate Q^pi, look m steps ahead, move pi.        [PGTS Alg. 1]"""
        draws = self._draws()
        calls_before = self._model_calls()

        # Visit states with pi_k and estimate Q^{pi_k} (line 2).
        numbers_anew = isinstance(self.world, ModelWorld) and self.world.forget()
        experience = whole_rollout(self.ranks, self.world, lambda: self._visit(draws.own))
        if numbers_anew and self.search is not None:
            self.search.reset()
        taken = self._taken(experience)
        fitting = draws.own if self.critic.draws_when_asked else draws.common
        losses = self.critic.fit(self.policy, experience, generator=fitting)

        # Look m steps ahead from the states with d(s) > 0.
        seen = taken or self._look(experience)

        # What happened is held to what the model says, before pi learns from either.
        self.model_check(experience, self.num_iterations)

        # pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d(s) (T^m Q)(s, .) ] (line 3), unless pi_k is good enough.
        if not self._is_enough(seen.certificate):
            losses |= self.update(
                self.policy,
                seen.observation_N,
                seen.advantage_NA,
                seen.weight_N,
                generator=draws.common,
                noise=seen.noise,
            )

        self.num_iterations += 1
        self.num_env_steps += experience.num_steps
        model_calls = self._agreed(self._model_calls() - calls_before)
        self.num_model_calls += model_calls
        return Iteration(**vars(seen), experience=experience, losses=losses, model_calls=model_calls)

    def _visit(self, generator: torch.Generator) -> Rollout:
        """The episodes of this process."""
        names = ("iteration", self.num_iterations, *self.ranks.names)
        return rollout(self.world, self.policy, self.horizon, seed=self.seed, names=names, generator=generator)

    def _draws(self) -> _Draws:
        """One stream where this process is alone."""
        own = self._stream(*self.ranks.names)
        return _Draws(own, own if self.ranks.size == 1 else self._stream("common"))

    def _agreed(self, model_calls: int) -> int:
        """The model calls of all processes; PgtsError if these hold different policies."""
        if self.ranks.size == 1:
            return model_calls
        told = self.ranks.gather("policies", lambda: (model_calls, checksum(self.policy.state_dict())))
        if len({policy for _, policy in told}) > 1:
            raise PgtsError("the ranks hold different policies: do they run on different hardware or versions?")
        return sum(calls for calls, _ in told)

    def _model_calls(self) -> int:
        return (0 if self.search is None else self.search.model_calls) + self.critic.model_calls

    def _look(self, experience: Rollout) -> PolicyBatch:
        """The lookahead from the visited states, at the given depth or at the first that sees enough."""
        states, weight_N = experience.visits(self.update.state_weight)
        observation_N = experience.first_observation_N
        pi_NA = self.policy.probs(observation_N)
        shallow = self._look_together(states, 0)
        v_N = (pi_NA * shallow.q_BA).sum(-1)
        check_finite("value", "the policy's value", v_N, states)
        _, occupancy_N = experience.visits("occupancy")
        assert self.certificates is not None
        starts = self.certificates.starts(experience, states, v_N)
        for depth in self.depths:
            look = self._look_together(states, depth) if depth else shallow
            gap_N = (look.q_BA.amax(-1) - v_N).clamp(min=0)
            bound, missing = self.certificates.bound(
                starts,
                (states, v_N, occupancy_N),
                expansions=depth + (self.critic.target == "v"),
                complete=float(look.pruned_BA.max()) == 0,
                experience=experience,
                number=self.num_iterations + 1,
            )
            if float(gap_N @ occupancy_N) > self.tolerance * missing or self._is_enough(bound):
                break
        advantage_NA = centred(look.q_BA, pi_NA, rounding=self._rounding(look))
        return PolicyBatch(observation_N, states, weight_N, pi_NA, advantage_NA, depth, look, gap_N, bound, look.noise)

    def _rounding(self, look: Lookahead) -> float:
        """Differences of lookahead values that rounding explains, in reward units."""
        eps = max(torch.finfo(dtype).eps for dtype in (look.q_BA.dtype, self.critic.dtype))
        return _ROUNDINGS * eps * float(look.q_BA[look.q_BA.isfinite()].abs().amax())

    def _taken(self, experience: Rollout) -> PolicyBatch | None:
        """The advantages of the actions taken, by the critic as it was when they were; None where a lookahead is
        asked for all actions instead."""
        if not isinstance(self.estimator, SampledAdvantages):
            return None
        alive_TB = experience.alive_TB
        observation_N = experience.observation_V
        pi_NA = self.policy.probs(observation_N)
        advantage_TB = self.estimator(experience, self.critic)
        advantage_NA = score_function(experience.action_TB[alive_TB], advantage_TB[alive_TB], pi_NA)
        weight_N = experience.visit_weight(self.update.state_weight)
        unknown_N = torch.full_like(weight_N, torch.nan)
        return PolicyBatch(observation_N, None, weight_N, pi_NA, advantage_NA, 0, None, unknown_N, math.inf, 0.0)

    @property
    def gamma(self) -> float:
        """The discount."""
        return self.world.gamma

    @property
    def mdp(self) -> TabularMDP:
        """The exact truth behind the environment; PgtsError where there is none."""
        if self.world.mdp is None:
            raise PgtsError(f"nothing exact is known of {self.source.name}")
        return self.world.mdp

    def policy_table(self) -> Float[Tensor, "S A"]:
        """pi(.|s) for all states, on the CPU in float64; PgtsError where they cannot be listed."""
        states = torch.arange(self.mdp.num_states, device=self.device)
        return listed(self.policy, states)

    def lookahead(self, state_N: Int[Tensor, "N"], *, depth: int | None = None) -> Lookahead:
        """(T^m Q)(s, .) at the given states, with the critic's estimate of Q^pi or v^pi at the leaves.

        Args:
            depth: m; default the depth of the training, or its largest if it is adaptive.
        """
        if self.search is None:
            raise PgtsError("with sampled advantages there is no lookahead")
        assert isinstance(self.world, ModelWorld)
        observe, critic = self.world.observe, self.critic
        leaf: Leaf = lambda s: critic.v(observe(s)) if critic.target == "v" else critic.q(observe(s))  # noqa: E731
        depth = self.depths[-1] if depth is None else depth
        return self.search(
            state_N,
            depth=depth,
            prior=lambda s: self.policy.probs(observe(s)),
            generator=self._search_stream(),
            **{f"{critic.target}_leaf": leaf},
        )

    def _look_together(self, state_N: Tensor, depth: int) -> Lookahead:
        """`lookahead`, in which each process has its part."""
        return whole_lookahead(self.ranks, state_N, lambda mine: self.lookahead(mine, depth=depth))

    def _stream(self, *names: str | int) -> torch.Generator:
        """A stream of this iteration."""
        return stream(self.seed, "iteration", self.num_iterations, *names, device=self.device)

    def _search_stream(self) -> torch.Generator:
        """All searches of an iteration see the same samples, so that their differences are not noise."""
        return self._stream("search")

    def _is_enough(self, bound: float) -> bool:
        """Whether the certificate lets training end."""
        return self.stop_at is not None and bound <= self.stop_at

    def learn(self, total_steps: int, *, callback: Callback | Sequence[Callback] = (), progress: bool = False) -> Self:
        """Iterate until `total_steps` environment steps have been made in all, counting those before this call.

        Args:
            callback: one or more, each called with (self, iteration) after each iteration; if one returns False, the
                training ends, in all processes.
            progress: show a progress bar.

        Raises:
            PgtsError: a callback that cannot be called; or the environment failed, naming step and seeds.
        """
        callbacks = [callback] if callable(callback) else callback
        if not isinstance(callbacks, Sequence) or not all(map(callable, callbacks)):
            raise PgtsError(f"callback is {callback!r}; it must be a function of (model, iteration), or a list of such")
        shown = progress and self.ranks.leads
        with tqdm(total=total_steps, initial=self.num_env_steps, unit="step", disable=not shown) as bar:
            while self.num_env_steps < total_steps:
                iteration = self.iterate()
                bar.update(iteration.experience.num_steps)
                answers = [call(self, iteration) for call in callbacks]
                going = self.ranks.gather("whether to go on", lambda: False not in answers)  # noqa: B023
                if not all(going) or self._is_enough(iteration.certificate):
                    break
        return self

    def predict(
        self, observation: ArrayLike, *, deterministic: bool = True, generator: torch.Generator | None = None
    ) -> np.ndarray | np.generic:
        """Actions for observations, as the environment takes them; no search.

        Args:
            observation: what the environment shows, or an array of it.
            deterministic: the most probable action, else one drawn from pi.
            generator: for drawing; default one from this model's seed, which goes on from call to call.
        """
        observation_N = self.world.encode(observation)
        shape = observation_N.shape[: observation_N.ndim - len(self.world.observation_space.shape or ())]
        observation_N = observation_N.reshape(-1, *observation_N.shape[len(shape) :])
        if deterministic:
            action_N = self.policy.probs(observation_N).argmax(-1)
        else:
            action_N = self.policy.sample(observation_N, generator=generator or self._predicting)
        action = action_N.cpu().numpy().reshape(shape)
        return action[()] if self._own_actions is None else self._own_actions[action]

    def save(self, path: str | Path) -> None:
        """Write everything that training or acting goes on from into one file with a checksum.

        An environment that was given as an object is left out: `load` must be given one. Of several processes all must
        call it, and the first one writes.

        Raises:
            PgtsError: a part was given as an object, so that no file can describe it, or an argument is no plain value;
                or there is a file that is no saved model: that stays.
        """
        content = self.content()
        self.ranks.first("a saved model", lambda: saving.write(saving.target(path), content))

    def content(self) -> dict[str, Any]:
        """What `save` writes: the arguments and the state. Of several processes all must ask for it."""
        return {"arguments": described(self._arguments) | {"device": str(self.device)}, "state": self.state_dict()}

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        env: Given | None = None,
        device: torch.device | str | None = None,
        trust_imports: bool = False,
    ) -> Self:
        """The model that `save` wrote; it trains on exactly as the saved one would have.

        Where a lookahead remembers the outcomes of states it asks the model for them again; `num_model_calls` does not
        count that.

        Args:
            env: the environment, where it was given to the saved model as an object; default its id.
            device: where to load it; default the device it was saved from.
            trust_imports: import the module that the id of its environment may name, as in "module:Id-v0". Nothing
                else in a file is executed.

        Raises:
            PgtsError: no such file, damaged, or not ours; or it names a module that is not trusted; or an environment
                is needed, or is not.
        """
        content = saving.read(path)
        if content.keys() != {"arguments", "state"}:
            raise PgtsError(f"{path} holds {sorted(map(str, content))}, not a model")
        arguments = content["arguments"]
        check_keys(f"{path}: arguments", arguments, {"env"}, others=set(signature(cls).parameters))
        saved_env = arguments["env"]
        if (env is None) == (saved_env is None):
            raise PgtsError(
                f"{path} names no environment, for it was given as an object: load it with env=..."
                if env is None
                else f"env is {env!r}; {path} has its own, {saved_env}"
            )
        if not trust_imports:
            check_imports(path, saved_env, arguments.get("env_kwargs"))
        arguments |= {"env": saved_env if env is None else env}
        try:
            model = cls(**arguments | ({} if device is None else {"device": str(device)}))
        except NO_STATE as error:
            if isinstance(error, PgtsError):
                raise
            raise PgtsError(f"{path}: its arguments make no model: {type(error).__name__}: {error}") from error
        try:
            model.load_state_dict(content["state"])
        except PgtsError as error:
            raise PgtsError(f"{path}: {error}") from error
        return model

    def state_dict(self) -> dict[str, Any]:
        """Policy, critic, update, what the search of each rank remembers, and counters: tensors on the CPU and plain
        values. Of several processes all must ask for it."""
        searches = self.ranks.gather("searches", self._search_state)
        return {
            "searches": dict(enumerate(searches)),
            "policy": self.policy.state_dict(),
            "critic": self.critic.state_dict(),
            "update": self.update.state_dict(),
            "num_iterations": self.num_iterations,
            "num_env_steps": self.num_env_steps,
            "num_model_calls": self.num_model_calls,
            "model_check": self.model_check.state_dict(),
        }

    def _search_state(self) -> dict[str, Any]:
        """What the search of this rank remembers, and its bounds."""
        if self.search is None or self.certificates is None:
            return {}
        with_states = self.world.mdp is not None
        upper = self.certificates.state_dict(with_states=with_states)
        return {**self.search.state_dict(with_states=with_states), "upper": upper}

    @torch.inference_mode(False)
    @torch.enable_grad()
    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave; or nothing of it, where it is no state of such a model.

        Raises:
            PgtsError: the part of it that does not fit is named.
        """
        counters = ("num_iterations", "num_env_steps", "num_model_calls")
        parts: dict[str, Policy | Critic | Update] = {
            "policy": self.policy,
            "critic": self.critic,
            "update": self.update,
        }
        check_keys("the saved state", state, {"searches", "model_check", *parts, *counters})
        for name in counters:
            check_count(name, state[name], least=0)
        before = {name: part.state_dict() for name, part in parts.items()}
        try:
            for name, part in parts.items():
                take_over(name, state[name], part.load_state_dict, part.state_dict)
            self.update.check(self.policy)
            self._load_search(state["searches"])
            check = self.model_check
            take_over("model_check", state["model_check"], check.load_state_dict, check.state_dict, is_all=False)
        except PgtsError:
            for name, part in parts.items():
                part.load_state_dict(before[name])
            raise
        for name in counters:
            setattr(self, name, state[name])

    def _load_search(self, searches: Any) -> None:
        """Take over what the search of this rank remembered."""
        if not isinstance(searches, Mapping) or set(searches) != set(range(len(searches))) or not searches:
            raise PgtsError("the saved state of searches is not one of each rank")
        rank, search, certificates = self.ranks.rank % len(searches), self.search, self.certificates
        if search is None or certificates is None:
            return

        def load(state: dict[str, Any]) -> None:
            search.load_state_dict(state)
            certificates.load_state_dict(state["upper"])

        take_over(f"searches.{rank}", searches[rank], load, self._search_state, has_bounds=True)

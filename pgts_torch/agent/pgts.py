"""Policy gradient with tree search, from rollouts.        [PGTS Alg. 1]"""

from collections.abc import Callable, Mapping, Sequence
from inspect import signature
from pathlib import Path
from typing import Any, Literal, Self, final

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor
from tqdm import tqdm

from pgts_torch.agent import saved, saving
from pgts_torch.agent.build import (
    Description,
    check_parts,
    chosen,
    make_critic,
    make_device,
    make_policy,
    make_search,
    make_update,
    plain,
)
from pgts_torch.agent.certificate import Certificates
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.estimators import Estimator, LookaheadEstimator, SampledEstimator
from pgts_torch.agent.iteration import Iteration
from pgts_torch.agent.make_world import make_world
from pgts_torch.agent.model_check import Mode, ModelCheck
from pgts_torch.agent.policies import Policy, listed
from pgts_torch.agent.policy_lookahead import PolicyLookahead
from pgts_torch.agent.ranks import present_ranks
from pgts_torch.agent.updates import Update
from pgts_torch.agent.visit import visit
from pgts_torch.agent.world import ModelWorld
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource, Given
from pgts_torch.models.rewards import RewardRange
from pgts_torch.options.arguments import read
from pgts_torch.options.rollouts import SampledAdvantages
from pgts_torch.search.engine import Search
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.seeding import SharedGenerators, stream
from pgts_torch.tabular.mdp import TabularMDP

Callback = Callable[["PGTS", Iteration], bool | None]
"""Called after each iteration; returning False ends the training. `agent.callbacks` has some."""


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
        horizon: Description = "fixed",
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
        options = read(self._arguments)
        num_envs = options.rollout.num_envs
        self.seed = seed
        self.device = make_device(device)
        self.ranks = present_ranks()
        with SharedGenerators(seed, "construction"):
            self.source = EnvSource.of(env, kwargs=env_kwargs, gamma=gamma, actions_per_dimension=actions_per_dimension)
            if num_envs < self.ranks.size and self.source.given is None:
                raise PgtsError(f"num_envs is {num_envs}; {self.ranks.size} ranks need at least as many")
            self.world = make_world(
                self.source,
                num_envs=self.ranks.count(num_envs),
                gamma=gamma,
                observation_key=observation_key,
                plain=isinstance(options.estimator, SampledAdvantages),
                action_repeat=options.search.action_repeat,
                device=device,
            )
        self._arguments["env"] = self.source.description
        if reward_range is not None:
            self.world.promise(RewardRange.of(reward_range))
        self.options = options = chosen(options, self.world)
        if not isinstance(policy, Policy):
            policy = make_policy(options.policy, self.world, seed=seed)
        if not isinstance(critic, Critic):
            critic = make_critic(options.critic, self.world, policy, options.estimator, seed=seed)
        if not isinstance(update, Update):
            update = make_update(options.update, policy)
        self.policy, self.critic, self.update, self.horizon = policy, critic, update, options.rollout.horizon
        self.search: Search | None = None
        self.certificates: Certificates | None = None
        self.depth_choice: DepthChoice | None = None
        if isinstance(options.estimator, SampledAdvantages):
            self.estimator: Estimator = SampledEstimator(policy, critic, options.estimator.lambda_, update.state_weight)
        else:
            assert isinstance(self.world, ModelWorld)
            self.search = make_search(options.search, self.world)
            depths, stop_at = options.search.depths, options.search.stop_at
            self.certificates = Certificates(self.world, self.search, critic, num_depths=len(depths), ranks=self.ranks)
            if stop_at is not None:
                self.certificates.check(f"stop_at is {stop_at}")
            if depth == "adaptive":
                self.certificates.check("depth is adaptive")
            look = PolicyLookahead(self.world, policy, critic, self.search, self.ranks)
            tolerance = options.search.filled("adaptive").tolerance
            self.depth_choice = DepthChoice(
                look, self.certificates, depths=depths, tolerance=tolerance, stop_at=stop_at
            )
            self.estimator = LookaheadEstimator(look, self.depth_choice, update.state_weight)
        is_asked = self.search is not None
        self.model_check = ModelCheck(
            self.world, mode=options.search.model_check, is_asked=is_asked, seed=seed, ranks=self.ranks
        )
        check_parts(self._arguments, self.world, policy, update)
        self._own_actions = self.source.own_actions(self.world.env)
        self._predicting = stream(seed, "predict", device=self.device)
        self.num_iterations = 0
        self.num_env_steps = 0
        self.num_model_calls = 0

    @torch.inference_mode(False)
    @torch.enable_grad()
    def iterate(self) -> Iteration:
        """One pass through the loop: visit states, estimate Q^pi, look m steps ahead, move pi.        [PGTS Alg. 1]"""
        draws = self.ranks.draws(self.seed, self.num_iterations, self.device)
        calls_before = self._model_calls()

        # Visit states with pi_k.
        experience = visit(self.world, self.policy, self.horizon, draws, self.ranks)

        # The advantages of actions taken, if these are wanted, stand on the critic before it learns from them.
        batch = self.estimator(experience, draws) if self.estimator.comes_first else None

        # Evaluate pi_k: estimate Q^{pi_k} (line 2).
        fitting = draws.own if self.critic.draws_when_asked else draws.common
        losses = self.critic.fit(self.policy, experience, generator=fitting)

        # Look m steps ahead from the states with d(s) > 0.
        batch = batch or self.estimator(experience, draws)

        # Hold what happened to what the model says, before pi learns from either.
        self.model_check(experience, self.num_iterations)

        # Update: pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d(s) (T^m Q)(s, .) ] (line 3), unless pi_k is good enough.
        if not batch.is_enough:
            losses |= self.update(
                self.policy,
                batch.observation_N,
                batch.advantage_NA,
                batch.weight_N,
                generator=draws.common,
                noise=batch.noise,
            )

        self.num_iterations += 1
        self.num_env_steps += experience.num_steps
        model_calls = self.ranks.total(self._model_calls() - calls_before, self.policy.state_dict())
        self.num_model_calls += model_calls
        return Iteration(**vars(batch), experience=experience, losses=losses, model_calls=model_calls)

    def _model_calls(self) -> int:
        return (0 if self.search is None else self.search.model_calls) + self.critic.model_calls

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
        choice = self.depth_choice
        if choice is None:
            raise PgtsError("with sampled advantages there is no lookahead")
        draws = self.ranks.draws(self.seed, self.num_iterations, self.device)
        return choice.look(state_N, choice.depths[-1] if depth is None else depth, draws.search())

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
                if not all(going) or iteration.is_enough:
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
        return {
            "arguments": plain(self._arguments, self.options) | {"device": str(self.device)},
            "state": self.state_dict(),
        }

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
        parameters, device = set(signature(cls).parameters), None if device is None else str(device)
        return saved.load_training(
            path, cls, parameters=parameters, env=env, device=device, trust_imports=trust_imports
        )

    def state_dict(self) -> dict[str, Any]:
        """Policy, critic, update, what the search of each rank remembers, and counters: tensors on the CPU and plain
        values. Of several processes all must ask for it."""
        return saved.state_of(self)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take over what `state_dict` gave; or nothing of it, where it is no state of such a model.

        Raises:
            PgtsError: the part of it that does not fit is named.
        """
        saved.restore(self, state)

"""Policy gradient with tree search, from rollouts.        [PGTS Alg. 1]"""

import json
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal, Self, final

import numpy as np
import torch
from tqdm import tqdm

from pgts_torch.agent.acting import Acting
from pgts_torch.agent.board import Board, hyperparameters
from pgts_torch.agent.build import Description, MakesModule, make_device
from pgts_torch.agent.critics import Critic
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.iteration import Iteration, PolicyBatch
from pgts_torch.agent.model_check import Mode
from pgts_torch.agent.parts import make_parts
from pgts_torch.agent.policies import Policy
from pgts_torch.agent.price import Pricing
from pgts_torch.agent.rollout import Rollout
from pgts_torch.agent.trained import Trained
from pgts_torch.agent.updates import Update
from pgts_torch.agent.visit import visit
from pgts_torch.agent.worlds import TabularWorld
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.models.base import Model
from pgts_torch.models.environments import Given
from pgts_torch.options.arguments import shortest
from pgts_torch.ranks import present_ranks
from pgts_torch.seeding import drawn_seed, stream

Callback = Callable[["PGTS", Iteration], bool | None]
"""A function that is called after each iteration; if it returns False, training ends. See also `agent.callbacks`."""


@final
class PGTS(Trained):
    """Trains a policy with the values of a depth-m lookahead at the states that it visits.

        pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta d^pi(s) (T^m Q^pi)(s, .) ]        [PGTS Eq. (3)]

    All random numbers of iteration k are from streams named by (seed, k), so that a loaded model continues exactly as
    the saved one would have. Where torch.distributed has a default process group, its processes train one policy
    together (`pgts_torch.ranks`); they must make the same calls, with the same arguments.

    Args:
        env: a Gymnasium id; a spec; an instance, from whose spec equal ones can be made; a function that makes one; or
            a VectorEnv that can reset by mask (`EnvSource`). The model of the lookahead is the environment's table
            (pgts/*, or a P table), else its dynamics in torch (CartPole, Acrobot, MountainCar, Pendulum), else a
            simulator that is restored from snapshots.
        depth, max_depth, tolerance, stop_at: m, or how it is chosen, and when training ends: see
            `options.search.LookaheadOptions`.
        search: the search for the lookahead: "auto", MCTS(simulations=32), {"type": "sampled", "samples": 8}, ...
        estimator: "lookahead", or SampledAdvantages() of actions taken, which needs depth 0, a network and no model.
        policy, critic, update: options of these parts (`pgts_torch.options`), their names, or the parts themselves.
            Default: tables where observations are numbered states, else networks. policy and critic also: a class of
            torch.nn.Module, or its "module:name" (`options.OwnModule`).
        model: what the lookahead queries. "auto": that of the environment, as above; "ensemble" (observations are
            vectors), "latent" (images) or "counts" (numbered states): one that is learned from the steps; or a `Model`
            whose states are the observations, or the "module:name" of what makes one.
        replay: "uniform": many updates an iteration, from episodes imagined in the model, which start in states
            visited so far; "none": one update, from the episodes of the iteration; "auto": uniform if the model learns.
        horizon: when the episodes of an iteration end (`options.rollouts`); "auto" depends on the replay.
        num_envs: environments, of all processes together. Default: 16, or 1 with the horizon steps; or those of a
            VectorEnv, in each process, beside which another number is an error.
        actions_per_dimension: the number of evenly spaced values, from the lowest to the highest, for each dimension of
            continuous actions; None: actions are Discrete, MultiDiscrete or MultiBinary, whose combinations
            are numbered.
        max_roots: the most visits that the lookahead of an update starts from, drawn where more states were visited.
        action_repeat, model_check: how often the model repeats each action, and whether it is checked against steps of
            the environment: see there too.
        actions, proposal_scale: how many actions a lookahead draws in each state, and how widely, where the policy is
            gaussian, for continuous actions: see there.
        observation_keys, image_channels: the entries of dictionary observations that are seen (default: all), and where
            images have their channels ("first", "last"; default: as their shape tells).
        action_masks: whether actions that are not legal, by `action_masks()` of the environment, `info["action_mask"]`
            or `observation["action_mask"]`, are never taken: "auto", "on" or "off" (`options.environment.Observed`).
        reward_range: the lowest and the highest reward of a single step; a reward outside of it is an error. `stop_at`
            and an adaptive depth need it where the model has no largest reward (simulators).
        gamma: discount. Default: the environment's own (pgts/*), else 0.99. A VectorEnv of pgts/* has its own.
        seed: of all random numbers; None: one is drawn and printed.   device: of policy, critic and model.
        env_kwargs: for gymnasium.make, if the environment is given by its id.

    Raises:
        PgtsError: parts that do not fit each other, or options out of range.
        MissingModel: the environment has no model that a lookahead could query.
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
        policy: Description | Policy | MakesModule | None = None,
        critic: Description | Critic | MakesModule | None = None,
        update: Description | Update | None = None,
        model: Description | Model = "auto",
        replay: Description = "auto",
        horizon: Description = "auto",
        num_envs: int | None = None,
        actions_per_dimension: int | None = None,
        max_roots: int | None = None,
        action_repeat: int = 1,
        actions: int | None = None,
        proposal_scale: float | None = None,
        model_check: Mode = "error",
        observation_keys: Sequence[str] | None = None,
        image_channels: Literal["first", "last"] | None = None,
        action_masks: Literal["auto", "on", "off"] = "auto",
        reward_range: Sequence[float] | None = None,
        gamma: float | None = None,
        seed: int | None = 0,
        device: torch.device | str = "cpu",
        env_kwargs: Mapping[str, Any] | None = None,
    ) -> None:
        given = {name: value for name, value in locals().items() if name != "self"}
        arguments = {name: value.item() if isinstance(value, np.generic) else value for name, value in given.items()}
        self.device, self.ranks = make_device(device), present_ranks()
        if seed is None:
            seed = arguments["seed"] = self.ranks.first("a seed", drawn_seed)
            if self.ranks.leads:
                print(f"note: seed is None; this training has the seed {seed}", file=sys.stderr)
        self.seed = seed
        parts = self.parts = make_parts(arguments, self.ranks)
        self.options, self.source, self.world = parts.options, parts.source, parts.world
        self.policy, self.critic, self.update = parts.policy, parts.critic, parts.update
        self.search, self.certificates, self.depth_choice = parts.search, parts.certificates, parts.depth_choice
        self.estimator, self.model_check = parts.estimator, parts.model_check
        self.episodes, self.dyna, self.posterior = parts.episodes, parts.dyna, parts.posterior
        self.gamma, self.horizon = self.world.gamma, self.options.rollout.horizon
        self.num_iterations = self.num_env_steps = self.num_model_calls = 0
        self.board: Board | None = None
        self._lacks: str | None = None
        depth = self.options.search.depth
        levels = depth + (self.critic.target == "v") if isinstance(depth, int) else None
        self.pricing = Pricing(
            self.options,
            self.search,
            self.dyna,
            levels=levels,
            calls=lambda: parts.model_calls,
            has_table=isinstance(self.world, TabularWorld),
            ranks=self.ranks,
        )
        self._arguments = arguments | {"env": self.source.description, "device": str(self.device)}
        self._act = Acting(self.world, self.source)
        self._generator = stream(seed, "predict", device=self.device)

    @torch.inference_mode(False)
    @torch.enable_grad()
    def iterate(self) -> Iteration:
        """Run one iteration: visit states, estimate Q^pi, look m steps ahead, update pi.        [PGTS Alg. 1]"""
        if self.world.env.closed:
            raise PgtsError("the environments of this training are closed: make another one, or load a saved one")
        self.check_complete()
        with self.ranks.united():
            return self._iterate()

    def _iterate(self) -> Iteration:
        draws = Draws.of(self.ranks, self.seed, self.num_iterations, self.device)
        calls_before = self.parts.model_calls
        self.pricing.begin()
        self.parts.follow(self.num_env_steps)

        # Visit states by episodes of pi_k, or of an `Explorer` where the model has optimism: the states where d(s), an
        # estimate of the occupancy d^{pi_k}(s), is positive.
        experience = visit(
            self.world,
            self.parts.visiting,
            self.episodes,
            self.horizon,
            draws,
            self.ranks,
            stepped=self.pricing.stepped,
        )
        if self.dyna is None:
            batch, losses = self._improve(experience, draws)
        else:
            # Do lines 2 and 3 for many imagined rollouts, which start in states visited so far.
            losses = self.dyna.learn(experience, draws)
            for imagined, own_draws in self.dyna.rollouts(draws):
                batch, latest = self._improve(imagined, own_draws)
            losses |= latest

        posterior = None if self.posterior is None else self.posterior.follow(experience, self.num_env_steps)
        target = self.options.search.stop_at
        if posterior is not None and target is not None:
            batch = replace(batch, is_enough=posterior <= target)
        self.num_iterations += 1
        self.num_env_steps += experience.share.total
        model_calls = self.ranks.total(self.parts.model_calls - calls_before, self.policy.state_dict)
        self.num_model_calls += model_calls
        self.pricing.end(model_calls)
        return Iteration(
            **vars(batch),
            experience=experience,
            num_steps=experience.share.total,
            losses=losses,
            model_calls=model_calls,
            posterior=posterior,
        )

    def _improve(self, rollout: Rollout, draws: Draws) -> tuple[PolicyBatch, dict[str, float]]:
        """Estimate Q^pi from a rollout, look m steps ahead, update pi. Return the batch, and the losses by name."""
        self.pricing.update()

        # Line 2: estimate Q^{pi_k}.
        losses = self.estimator.evaluate(rollout, draws)

        # Look m steps ahead from the visited states: (T^m Q^{pi_k})(s, .).
        with self.pricing.lookahead():
            batch = self.estimator(rollout, draws)

        # Compare the steps of the environment with the model, before pi is updated (with replay `Dyna.learn` has).
        if self.dyna is None:
            self.model_check(rollout, self.num_iterations)

        # Line 3: pi_{k+1}(.|s) = proj[ pi_k(.|s) + eta_k d(s) (T^m Q^{pi_k})(s, .) ], unless pi_k is good enough.
        if not batch.is_enough:
            losses |= self.update(self.policy, batch, generator=draws.common)
        return batch, losses

    def __repr__(self) -> str:
        """The call that makes such a training, where the environment is an id; what is queried, and how far it is."""
        others = {name: self._arguments[name] for name in ("gamma", "env_kwargs", "seed", "device")}
        given = shortest(self.options) | {
            name: each for name, each in others.items() if each not in (None, {}, 0, "cpu")
        }
        model = getattr(self.world, "model", None)
        queried = "no model" if self.depth_choice is None or model is None else type(model).__name__
        env = self._arguments["env"]
        arguments = [
            repr(env) if isinstance(env, str) else self.source.name,
            *(f"{name}={value!r}" for name, value in given.items()),
        ]
        return f"PGTS({', '.join(arguments)})  # {queried}, {self.num_env_steps:,} steps"

    def learn(
        self,
        total_steps: int | float,
        *,
        callback: Callback | Sequence[Callback] = (),
        progress: bool | None = None,
        tensorboard: str | Path | None = None,
    ) -> Self:
        """Iterate until there are `total_steps` environment steps, including those before this call. Iterations are
        whole, so there may be more by one iteration.

        Args:
            callback: one or more, each called with (self, iteration) after each iteration; if one returns False,
                training ends in all processes.
            progress: show a progress bar, and say what an iteration costs; None: the bar alone, and only on a terminal.
                From a second on the cost is always said, before it is spent where the lookahead takes long; from 30
                seconds on with what makes it cheaper.
            tensorboard: a folder for TensorBoard events, with the tags of `pgts train`: hyper-parameters and
                configuration, the numbers of each iteration, histograms, pictures of tables where an `EvalCallback`
                evaluates and at the end, and results. A training that goes on writes into the same folder.

        Raises:
            PgtsError: a number of steps that is none; a callback that cannot be called; the folder is none, or has
                events of another training; or the environment failed, naming step and seeds.
        """
        if isinstance(total_steps, float) and total_steps.is_integer():
            total_steps = int(total_steps)  # 1e5
        total_steps = check_count("total_steps", total_steps, least=0)
        callbacks = [callback] if callable(callback) else callback
        if not isinstance(callbacks, Sequence) or not all(map(callable, callbacks)):
            raise PgtsError(f"callback is {callback!r}; it must be a function of (model, iteration), or a list of such")
        hidden = True if not self.ranks.leads else None if progress is None else not progress
        with ExitStack() as held:
            bar = held.enter_context(tqdm(total=total_steps, initial=self.num_env_steps, unit="step", disable=hidden))
            if tensorboard is not None:
                self.board = held.enter_context(self._opened(tensorboard, total_steps))
                held.callback(setattr, self, "board", None)
            while self.num_env_steps < total_steps:
                iteration = self.iterate()
                bar.update(iteration.num_steps)
                if self.board is not None:
                    self.board.follow(iteration, self.counters)
                goes_on = False not in [call(self, iteration) for call in callbacks]
                if not all(self.ranks.gather("whether to go on", lambda: goes_on)) or iteration.is_enough:  # noqa: B023
                    break
            if self.board is not None:
                self.board.end()
        return self

    def _opened(self, folder: str | Path, total_steps: int) -> Board:
        env = {"id": self.source.name, "kwargs": dict(self._arguments["env_kwargs"] or {}), "gamma": self.gamma}
        options = self.options.plain()
        options["env"] |= env
        return Board(
            folder,
            self.parts,
            self.ranks,
            options=hyperparameters(self.parts, env_kwargs=self._arguments["env_kwargs"], seed=self.seed),
            text=f"{self!r}\n\n{json.dumps(options, indent=2, default=str)}",
            total_steps=total_steps,
            counters=self.counters,
        )

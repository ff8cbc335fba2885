"""What a training offers beside its iterations: its policy acts, looks ahead, is watched, exported and saved."""

from abc import ABC
from contextlib import closing
from pathlib import Path
from typing import Any, Self, overload

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from torch import Tensor

from pgts_torch.agent import exporting, recording, saved, saving
from pgts_torch.agent.acting import Acting
from pgts_torch.agent.build import plain
from pgts_torch.agent.depth import DepthChoice
from pgts_torch.agent.diagnostics import Counters
from pgts_torch.agent.draws import Draws
from pgts_torch.agent.gaussian import GaussianPolicy
from pgts_torch.agent.parts import Parts
from pgts_torch.agent.policies import Policy, exact_probs
from pgts_torch.agent.watching import Watching
from pgts_torch.agent.world import World
from pgts_torch.agent.worlds import SimulatedWorld, TabularWorld
from pgts_torch.errors import PgtsError
from pgts_torch.models.environments import EnvSource, Given, close_environments
from pgts_torch.ranks import Ranks
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.tabular.mdp import TabularMDP


class Trained(ABC):
    """A training as it is used, whatever it does in an iteration; `PGTS` says what its attributes are."""

    device: torch.device
    ranks: Ranks
    seed: int
    parts: Parts
    source: EnvSource
    world: World
    policy: Policy
    depth_choice: DepthChoice | None
    num_iterations: int
    num_env_steps: int
    num_model_calls: int
    _arguments: dict[str, Any]
    _act: Acting
    _generator: torch.Generator
    _lacks: str | None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def mdp(self) -> TabularMDP:
        """The exact MDP of the environment; PgtsError where it is not known."""
        if self.world.mdp is None:
            raise PgtsError(f"nothing exact is known of {self.source.name}")
        return self.world.mdp

    def policy_table(self) -> Float[Tensor, "S A"]:
        """pi(.|s) for all states, on the CPU in float64; PgtsError where states are not numbered."""
        if not isinstance(self.world, TabularWorld):
            raise PgtsError(f"states of {self.source.name} are not numbered")
        return exact_probs(self.policy, torch.arange(self.world.mdp_shape[0], device=self.device))

    def lookahead(self, state_N: Int[Tensor, "N"], *, depth: int | None = None) -> Lookahead:
        """(T^m Q)(s, .) at the given states, with the critic's estimate of Q^pi or v^pi at the leaves. The default of m
        is the depth of the training, or the largest of an adaptive depth."""
        if self.depth_choice is None:
            raise PgtsError("with sampled advantages there is no lookahead")
        depth = self.depth_choice.depths[-1] if depth is None else depth
        draws = Draws.of(self.ranks, self.seed, self.num_iterations, self.device)
        if isinstance(self.policy, GaussianPolicy):
            self.depth_choice.look.restart(draws.search())
        return self.depth_choice.look(state_N, depth=depth, generator=draws.search())

    def close(self) -> None:
        """Close the environments, but not a VectorEnv that was given, which is its owner's. The policy remains."""
        if self.source.given is None and not self.world.env.closed:
            close_environments(self.world.env)
            if isinstance(self.world, SimulatedWorld):
                self.world.model.env.close()

    @property
    def counters(self) -> Counters:
        """What it has done so far."""
        return Counters(self.num_iterations, self.num_env_steps, self.num_model_calls)

    @overload
    def predict(
        self,
        observation: ArrayLike,
        *,
        deterministic: bool = True,
        action_mask: ArrayLike | None = None,
        generator: torch.Generator | None = None,
        state: None = None,
        episode_start: None = None,
    ) -> np.ndarray | np.generic: ...

    @overload
    def predict(
        self,
        observation: ArrayLike,
        *,
        state: Any,
        episode_start: ArrayLike,
        deterministic: bool = True,
        action_masks: ArrayLike | None = None,
    ) -> tuple[np.ndarray | np.generic, Any]: ...

    def predict(
        self,
        observation: ArrayLike,
        *,
        deterministic: bool = True,
        action_mask: ArrayLike | None = None,
        generator: torch.Generator | None = None,
        state: Any = None,
        episode_start: ArrayLike | None = None,
        action_masks: ArrayLike | None = None,
    ) -> Any:
        """Return actions for observations, in the form of the environment; without search.

        Args:
            observation: an observation of the environment, or an array of them.
            action_mask: which actions are legal there, as the environment says it: a vector, or a row for each of an
                array of observations. It is needed where the environment has action masks.
            deterministic: take the most probable action, of a gaussian policy the mean; else sample from pi.
            generator: for sampling; default: one with this model's seed, which continues from call to call.
            state, episode_start, action_masks: given by `evaluate_policy` of stable-baselines3 and sb3-contrib. With
                episode_start the pair (actions, state) is returned, as by their models; the masks are as `action_mask`.

        Raises:
            PgtsError: an observation or a mask is none of the environment, or the mask is missing, or of no use.
        """
        generator = generator or self._generator
        if action_masks is not None and action_mask is not None:
            raise PgtsError("action_mask and action_masks are the same: give one of them")
        action_mask = action_masks if action_mask is None else action_mask
        actions = self._act(self.policy, observation, action_mask, deterministic=deterministic, generator=generator)
        return actions if episode_start is None else (actions, state)

    def record(
        self,
        path: str | Path,
        *,
        episodes: int = 1,
        fps: float | None = None,
        **options: Any,
    ) -> list[recording.Seen]:
        """Write episodes as a film, beside each picture the lookahead's values and the policy's probabilities in that
        state; as text where `path` ends in .txt. Training is not affected, but states of simulators and vectors that
        an iteration has numbered lose their numbers.

        Args:
            path: a .gif, an .mp4 (with the extra `video`) or a .txt; a file of that kind is replaced.
            episodes: how many.
            fps: pictures a second; default: as the environment says, or 10.
            options: seed, deterministic, depth and steps, as of `watching.Watching`.

        Returns:
            Of each episode the seed, the length, the return and how it ended. If several processes train together all
            must call it, and the first one watches.

        Raises:
            PgtsError: an argument out of range; there is another file at `path`; the environment cannot be drawn; or it
                failed, naming step and seed.
        """
        mode = "ansi" if recording.suffix_of(path) == ".txt" else "rgb_array"

        def record() -> list[recording.Seen]:
            with closing(self.watching(**options, mode=mode)) as watching:
                return recording.record(path, watching, episodes=episodes, fps=fps, name=self.source.name)

        return self.ranks.first("a recording", record)

    def watching(self, **options: Any) -> Watching:
        """Episodes of the policy, to be looked at step by step; the arguments are those of `watching.Watching`."""
        return Watching(self.parts, training_seed=self.seed, **options)

    def export(self, path: str | Path, *, format: exporting.Format | None = None) -> dict[str, Any]:
        """Write the policy as a program that acts without this package: from observations, as the environment gives
        them, to probabilities (or mean and standard deviation) and to the action that `predict` returns. It does not
        check what it is given. If several processes train together all must call it, and the first one writes.

        Args:
            path: an earlier export there is replaced.
            format: "torch" (read by torch.export.load) or "onnx"; default: by the end of `path`, .pt2 or .onnx.

        Returns:
            What the file says of itself: the environment, inputs and outputs by name.

        Raises:
            PgtsError: the policy is of a class of your own, or a module of it cannot be traced; a package is missing;
                or there is another file at `path`.
        """
        notes = {"environment": self.source.name, "num_env_steps": self.num_env_steps}
        parts: dict[str, Any] = {"world": self.world, "source": self.source, "policy": self.policy, "notes": notes}
        return self.ranks.first("an exported policy", lambda: exporting.export(path, format, **parts))

    def save(self, path: str | Path) -> None:
        """Write arguments and state into one file with a checksum, without an environment that was given as an object.
        If several processes train together all must call it, and the first one writes.

        Raises:
            PgtsError: a part was given as an object, which cannot be saved, or an argument is no plain value; or there
                is another file at `path`, which is not replaced.
        """
        content = self.content()
        self.ranks.first("a saved model", lambda: saving.write(saving.target(path), content))

    def content(self) -> dict[str, Any]:
        """Return the content of `save`: arguments and state. If several processes train together all must call it."""
        return {"arguments": plain(self._arguments, self.parts.options), "state": self.state_dict()}

    @classmethod
    def load(
        cls,
        path: str | Path,
        *,
        env: Given | None = None,
        device: torch.device | str | None = None,
        trust_imports: bool = False,
    ) -> Self:
        """Return the model that `save` wrote; it trains exactly as the saved one would have. The outcomes known to its
        lookahead are queried again, which `num_model_calls` does not count.

        Args:
            env: the environment, if it was given to the saved model as an object; default: the saved id.
            device: where to load it; default: the device it was saved from.
            trust_imports: whether modules that it names are imported, as that of the environment "module:Id-v0" or of
                the policy "module:Net". Nothing else in a file is executed.

        Raises:
            PgtsError: no such file, damaged, or no saved model; it names a module that is not trusted; env is missing,
                or not needed.
        """
        return saved.load_training(path, cls, env=env, device=device, trust_imports=trust_imports)

    def state_dict(self) -> dict[str, Any]:
        """Return the states of all parts, and the counters. If several processes train together all must call it."""
        self.check_complete()
        return saved.state_of(self.parts, self.ranks) | {name: getattr(self, name) for name in saved.COUNTERS}

    def check_complete(self) -> None:
        """PgtsError where training cannot go on, because several processes have saved this model and not as many have
        loaded it, while each has kept steps, or episodes, of its own. The policy can be used all the same."""
        if self._lacks is not None:
            raise PgtsError(self._lacks)

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Load what `state_dict` returned; PgtsError, and nothing is loaded, if it is no state of such a model."""
        counters, self._lacks = saved.restore(self.parts, self.ranks, state)
        self.num_iterations, self.num_env_steps, self.num_model_calls = counters

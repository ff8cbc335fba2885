"""Thousands of environments of one tabular MDP, stepped together."""

from collections.abc import Sequence
from functools import cached_property
from typing import Any, final

import gymnasium
import numpy as np
from gymnasium.core import RenderFrame
from gymnasium.error import ResetNeeded
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space
from jaxtyping import Bool, Float, Int
from numpy.typing import ArrayLike

from pgts_torch.envs.drawing import Drawing
from pgts_torch.envs.sampler import OutcomeSampler
from pgts_torch.envs.tabular import RENDER_FPS, check_options, check_render_mode
from pgts_torch.errors import PgtsError, check_count
from pgts_torch.tabular.mdp import TabularMDP

MAX_FRAMES = 64
"""Most environments that can be rendered: a frame is up to 0.75 MB."""

States = Int[np.ndarray, "B"]
Rewards = Float[np.ndarray, "B"]
Flags = Bool[np.ndarray, "B"]


@final
class TabularVectorEnv(gymnasium.vector.VectorEnv):
    """`num_envs` environments of one MDP that share one random generator; a step is a few array operations for all.

    Rewards, `info["discount"]` and `info["action_mask"]` are those of `TabularEnv`. An environment is truncated when it
    has made `max_episode_steps` steps. What then happens to it is Gymnasium's `AutoresetMode`:

        NEXT_STEP   the next step starts a new episode instead of stepping: reward 0, its action ignored
        SAME_STEP   a new episode starts at once; the last state is in `info["final_obs"]`
        DISABLED    the caller resets it with `options={"reset_mask": mask}`; stepping it before is an error

    `info["discount"]` always belongs to the step just made, also where SAME_STEP has started a new episode;
    `info["_discount"]` is False only where NEXT_STEP made no step.

    Args:
        mdp: the MDP; kept as `mdp`.
        num_envs: how many environments.
        max_episode_steps: None is no limit.
        autoreset_mode: a mode or its value, for instance "SameStep".
        render_mode: "rgb_array" or None.

    Raises:
        PgtsError: an argument, an option, an action, or a state to start in cannot be used.
        ResetNeeded: `step` or `render` before the first reset, or in DISABLED mode a step of an environment that
            is over.
    """

    def __init__(
        self,
        mdp: TabularMDP,
        num_envs: int = 1,
        *,
        max_episode_steps: int | None = None,
        autoreset_mode: AutoresetMode | str = AutoresetMode.NEXT_STEP,
        render_mode: str | None = None,
    ) -> None:
        check_count("num_envs", num_envs)
        if max_episode_steps is not None:
            check_count("max_episode_steps", max_episode_steps)
        check_render_mode(render_mode, ["rgb_array"])
        if render_mode is not None and num_envs > MAX_FRAMES:
            raise PgtsError(f"num_envs is {num_envs}; at most {MAX_FRAMES} environments can be rendered")
        self.mdp = mdp
        self.num_envs = num_envs
        self.max_episode_steps = max_episode_steps
        self.autoreset_mode = _check_mode(autoreset_mode)
        self.render_mode = render_mode
        self.metadata = {
            "render_modes": ["rgb_array"],
            "render_fps": RENDER_FPS,
            "discounts": True,
            "autoreset_mode": self.autoreset_mode,
        }
        self.single_observation_space = gymnasium.spaces.Discrete(mdp.num_states)
        self.single_action_space = gymnasium.spaces.Discrete(mdp.num_actions)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._sampler = OutcomeSampler(mdp)
        self._was_reset = False
        self._state_B = np.zeros(num_envs, dtype=np.int64)
        self._elapsed_B = np.zeros(num_envs, dtype=np.int64)
        self._over_B = np.zeros(num_envs, dtype=np.bool_)

    def reset(
        self, *, seed: int | Sequence[int] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[States, dict[str, Any]]:
        """Start new episodes in all environments, or in some.

        Args:
            seed: of the one generator; num_envs integers together seed it as well.
            options: `reset_mask` [B]: which environments, default all. `state`: where they start, one state or one
                for each (of which those of the mask are used), default sampled from the start distribution.
        """
        check_options(options, ("reset_mask", "state"))
        options = options or {}
        mask_B = self._check_mask(options.get("reset_mask"))
        given = options.get("state")
        state_B = None if given is None else self._check_numbers("state", given, self.mdp.num_states)
        self._seed(seed)
        self._start_episodes(mask_B, state_B)
        self._was_reset = True
        return self._state_B.copy(), self._sampler.masks(self._state_B)

    def step(self, actions: ArrayLike) -> tuple[States, Rewards, Flags, Flags, dict[str, Any]]:
        """Sample one outcome for every environment: states, rewards, terminated, truncated, info, each of shape [B]."""
        action_B = self._check_numbers("action", actions, self.mdp.num_actions)
        if not self._was_reset:
            raise ResetNeeded("Cannot call env.step() before calling env.reset()")
        if self.autoreset_mode == AutoresetMode.DISABLED and self._over_B.any():
            raise ResetNeeded(
                f"the episode of environment {int(self._over_B.argmax())} is over; "
                f"reset it with env.reset(options={{'reset_mask': mask}}) before the next env.step()"
            )
        self._sampler.check_legal(self._state_B[~self._over_B], action_B[~self._over_B])
        pair_B = self._state_B * self.mdp.num_actions + action_B
        outcome_B = self._sampler.outcomes(self.np_random, pair_B)
        self._state_B = self._sampler.child_SAK.take(outcome_B)
        self._elapsed_B += 1
        reward_B = self._sampler.reward_SAK.take(outcome_B)
        discount_B = self._sampler.discount_SAK.take(outcome_B)
        stepped_B = ~self._over_B
        if self._over_B.any():  # NEXT_STEP: these were stepped with the others, and now begin a new episode
            reward_B[self._over_B] = discount_B[self._over_B] = 0.0
            self._start_episodes(self._over_B)
        terminated_B = (discount_B == 0) & stepped_B
        truncated_B = self._elapsed_B >= (self.max_episode_steps or np.inf)
        self._over_B = terminated_B | truncated_B
        info: dict[str, Any] = {"discount": discount_B, "_discount": stepped_B}
        if self.autoreset_mode == AutoresetMode.SAME_STEP and self._over_B.any():
            info |= self._final(discount_B)
            self._start_episodes(self._over_B)
        info |= self._sampler.masks(self._state_B)
        return self._state_B.copy(), reward_B, terminated_B, truncated_B, info

    def render(self) -> tuple[RenderFrame, ...]:
        """A picture [height, width, 3] of each environment."""
        if self.render_mode is None:
            raise PgtsError("render_mode is None; give render_mode='rgb_array' to gymnasium.make_vec")
        if not self._was_reset:
            raise ResetNeeded("Cannot call env.render() before calling env.reset()")
        return tuple(self._drawing.picture(int(state)) for state in self._state_B)

    @cached_property
    def _drawing(self) -> Drawing:
        return Drawing(self.mdp)

    def _start_episodes(self, mask_B: Flags, state_B: States | None = None) -> None:
        count = int(np.count_nonzero(mask_B))
        self._state_B[mask_B] = self._sampler.starts(self.np_random, count) if state_B is None else state_B[mask_B]
        self._elapsed_B[mask_B] = 0
        self._over_B = self._over_B & ~mask_B

    def _final(self, discount_B: Rewards) -> dict[str, Any]:
        """How the episodes ended that are over, in the form that Gymnasium's `SyncVectorEnv` gives it."""
        over_B = self._over_B
        final_B = np.full(self.num_envs, None, dtype=object)
        final_B[over_B] = self._state_B[over_B]
        return {
            "final_obs": final_B,
            "_final_obs": over_B.copy(),
            "final_info": {"discount": np.where(over_B, discount_B, 0.0), "_discount": over_B.copy()},
            "_final_info": over_B.copy(),
        }

    def _seed(self, seed: int | Sequence[int] | None) -> None:
        if seed is None or isinstance(seed, int):
            super().reset(seed=seed)
            return
        if len(seed) != self.num_envs or not all(isinstance(word, int) and word >= 0 for word in seed):
            raise PgtsError(f"seed is {seed}; it must be an integer or {self.num_envs} integers of at least 0")
        self.np_random = np.random.default_rng(np.random.SeedSequence(seed))

    def _check_numbers(self, kind: str, given: ArrayLike, count: int) -> States:
        """One number below `count` for each environment; a single state stands for all of them."""
        number_B = np.asarray(given)
        if number_B.shape == () and kind == "state":
            number_B = np.broadcast_to(number_B, (self.num_envs,))
        if number_B.shape != (self.num_envs,) or not np.issubdtype(number_B.dtype, np.integer):
            raise PgtsError(
                f"{kind}s have shape {number_B.shape} and dtype {number_B.dtype}; they must be {self.num_envs} integers"
            )
        if number_B.min() < 0 or number_B.max() >= count:
            index = int(((number_B < 0) | (number_B >= count)).argmax())
            raise PgtsError(
                f"{kind} {number_B[index]} of environment {index} does not exist; {kind}s are 0 to {count - 1}"
            )
        return number_B

    def _check_mask(self, mask: Any) -> Flags:
        if mask is None:
            return np.ones(self.num_envs, dtype=np.bool_)
        mask_B = np.asarray(mask)
        if mask_B.shape != (self.num_envs,) or mask_B.dtype != np.bool_ or not mask_B.any():
            raise PgtsError(
                f"reset_mask has shape {mask_B.shape} and dtype {mask_B.dtype} and names {np.count_nonzero(mask_B)} "
                f"environments; it must be {self.num_envs} booleans that name at least one"
            )
        if not self._was_reset and not mask_B.all():
            raise ResetNeeded("Cannot reset some environments before env.reset() has started all of them")
        return mask_B


def _check_mode(mode: AutoresetMode | str) -> AutoresetMode:
    try:
        return AutoresetMode(mode)
    except ValueError:
        known = [known.value for known in AutoresetMode]
        raise PgtsError(f"autoreset_mode is {mode!r}; it must be an AutoresetMode or one of {known}") from None

"""Episodes of a trained policy, step by step, with what the lookahead says of each state."""

from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext, suppress
from typing import Any, Literal, NamedTuple, final

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.vector.utils import iterate
from torch import Tensor

from pgts_torch.agent.components import legal_in
from pgts_torch.agent.episodes import UNLIMITED_LENGTH, Episodes
from pgts_torch.agent.gaussian import GaussianPolicy, Mean
from pgts_torch.agent.parts import Parts, make_look
from pgts_torch.agent.world import ModelWorld, World
from pgts_torch.errors import PgtsError, check_count, failure
from pgts_torch.models.environments import EnvSource, close_environments
from pgts_torch.models.masks import Masked
from pgts_torch.models.wrappers import wrappers_of
from pgts_torch.seeding import SharedGenerators, stream

Mode = Literal["rgb_array", "ansi"]


class NoPicture(PgtsError):
    """An environment cannot be drawn in this mode."""


class Choice(NamedTuple):
    """An action in a state.

    name: in words.
    prob: pi(a|s), of drawn actions their weight; None: the policy has a density.
    value: (T^m Q)(s, a), -inf where the action is not legal; None: nothing is known.
    """

    name: str
    prob: float | None
    value: float | None
    is_taken: bool


class Moment(NamedTuple):
    """A state of an episode.

    episode, step: numbers from 0 on.   seed: of the reset.   total: the sum of rewards so far.
    choices: the actions; none where the episode is over.   depth: m; None: there is no lookahead.
    note: more about the policy.   ended: how the episode is over, in words; None: it goes on.
    picture: what the environment has rendered; None: nothing.
    """

    episode: int
    seed: int
    step: int
    total: float
    observation: Any
    choices: Sequence[Choice]
    depth: int | None
    note: str
    ended: str | None
    picture: Any


@final
class Watching:
    """Episodes of the policy of a training, in environments of their own. The training is not affected, but for the
    numbers of states, which get other ones where they are no table.

    Args:
        training_seed: of the training; what a lookahead samples is from the stream (training_seed, "watch").
        seed: episode k begins with reset(seed=seed + k).
        deterministic: take the most probable action, of a gaussian policy the mean; else sample from pi.
        depth: m; None: that of the training, or the largest of an adaptive depth.
        steps: the most steps of an episode; None: the time limit, or 1,000 where there is none.
        mode: how the environment is drawn: "rgb_array", or "ansi", as text, where it can; None: it is not.

    Raises:
        PgtsError: a number out of range; a depth where there is no lookahead; or no more environments of this kind can
            be made.
        NoPicture: the environment cannot be drawn so.
    """

    def __init__(
        self,
        parts: Parts,
        *,
        training_seed: int,
        seed: int = 0,
        deterministic: bool = True,
        depth: int | None = None,
        steps: int | None = None,
        mode: Mode | None = None,
    ) -> None:
        check_count("seed", seed, least=0)
        if steps is not None:
            check_count("steps", steps)
        self._parts, self._training_seed, self._seed, self._deterministic = parts, training_seed, seed, deterministic
        source = self._source = parts.source
        self._limit = steps or source.time_limit or UNLIMITED_LENGTH
        self.depth = None if parts.depth_choice is None else parts.depth_choice.depths[-1]
        if depth is not None:
            if self.depth is None:
                raise PgtsError(f"depth is {depth}; with sampled advantages there is no lookahead")
            check_count("depth", depth, least=0)
            self.depth = depth
        with SharedGenerators(seed, "watch", "construction"):
            self._env = SyncVectorEnv([source.like], autoreset_mode=AutoresetMode.DISABLED)
        self.rate = float(self._env.metadata.get("render_fps") or _RATE)
        world = self._world = parts.world.beside(self._env)
        self._look = None
        if parts.depth_choice is not None:
            assert isinstance(world, ModelWorld)
            trained = parts.depth_choice.look
            self._look = make_look(world, trained.policy, trained.critic, parts.options)
            self._look.search.load_state_dict(trained.search.state_dict(with_states=False))
        self._squash, self._own_actions = source.squash(self._env), source.own_actions(self._env)
        self._names = _names_of(self._env.envs[0], world, self._own_actions)
        self._twin: _Twin | None = None
        if mode is not None:
            with suppress(*[NoPicture] * (mode == "ansi")):
                self._twin = _Twin(source, mode, self._env)

    def close(self) -> None:
        """Close the environments. Where states have other numbers now the lookahead of the training forgets them."""
        close_environments(self._env)
        if self._parts.depth_choice is not None:
            self._parts.depth_choice.look.restart(self._generator())
        if self._twin is not None:
            self._twin.env.close()

    def __call__(self, episodes: int) -> Iterator[Moment]:
        """Yield each state of so many episodes, the last one of an episode without choices."""
        for k in range(episodes):
            yield from self._episode(k)

    def _episode(self, k: int) -> Iterator[Moment]:
        seed, total, ended = self._seed + k, 0.0, None
        episodes = Episodes(self._env, gamma=self._world.gamma, seeds=[seed], masks=self._world.masks)
        with episodes.named("at the start"), self._shared(k, 0):
            episodes.reset()
        self._follow(episodes, k, 0, seed=seed)
        for step in range(self._limit):
            action, choices, note = self._choose(episodes.observation, self._generator(k, step))
            shown = seed, step, total, self._seen(episodes)
            yield Moment(k, *shown, choices, self.depth, note, None, self._picture())
            with episodes.named(f"in step {step}"), self._shared(k, step + 1):
                reward_1, discount_1, truncated_1 = episodes.step(action, np.ones(1, dtype=bool))
            self._follow(episodes, k, step + 1, action=action[0])
            total += float(reward_1[0])
            if discount_1[0] == 0 or truncated_1[0]:
                ended = "cut off by the environment" if truncated_1[0] else "terminated"
                break
        ended = ended or f"cut off after {self._limit} steps"
        yield Moment(k, seed, step + 1, total, self._seen(episodes), (), self.depth, "", ended, self._picture())

    def _choose(self, observation: Any, generator: torch.Generator) -> tuple[np.ndarray, list[Choice], str]:
        """The action that is taken, all of them, and more about the policy."""
        world, policy = self._world, self._parts.policy
        encoded_1, q_A, drawn = world.encode(observation), None, None
        if self._look is not None:
            assert isinstance(world, ModelWorld)
            assert self.depth is not None
            world.reset_numbers()
            self._look.restart(generator)
            state_1 = world.numbers(world.read(observation, encoded_1))
            q_A = self._look(state_1, depth=self.depth, generator=generator).q_BA[0].tolist()
            drawn = self._look.drawn(state_1)
        seen_1 = world.perceive(encoded_1)
        if isinstance(policy, GaussianPolicy):
            one = Mean(policy) if self._deterministic else policy
            vector_1X = one.sample(seen_1, generator=generator).cpu()
            choices = [Choice(self._named(vector_1X), None, None, True)]
            if drawn is not None:
                assert q_A is not None
                names = map(self._named, drawn.action_NKX[0].cpu().split(1))
                every = sorted(zip(q_A, names, drawn.prob_NK[0].tolist(), strict=True), reverse=True)
                choices += [Choice(action, prob, value, False) for value, action, prob in every]
            normals = policy.normals(seen_1)
            note = f"mean {_vector(normals.mean_NX[0])}, std {_vector(normals.std_NX[0], '')}, before they are squashed"
            return vector_1X.numpy(), choices, note
        prob_A = policy.probs(seen_1)[0].cpu()
        taken = int(prob_A.argmax()) if self._deterministic else int(policy.sample(seen_1, generator=generator))
        legal_1A = legal_in(world.perceived_space, seen_1)
        values: list[float | None] = [None] * len(prob_A) if q_A is None else list(q_A)
        if legal_1A is not None:
            values = [value if legal else -np.inf for value, legal in zip(values, legal_1A[0].tolist(), strict=True)]
        every_A = zip(self._names, prob_A.tolist(), values, strict=True)
        return np.array([taken]), [Choice(*each, a == taken) for a, each in enumerate(every_A)], ""

    def _named(self, vector_1X: Tensor) -> str:
        assert self._squash is not None
        return _vector(self._squash.actions(vector_1X.numpy()).reshape(-1))

    def _seen(self, episodes: Episodes) -> Any:
        """The observation as the environment gives it."""
        observation = episodes.observation
        observation = observation.observation if isinstance(observation, Masked) else observation
        return next(iter(iterate(self._env.observation_space, observation)))

    def _generator(self, *names: int) -> torch.Generator:
        return stream(self._training_seed, "watch", *names, device=self._world.device)

    def _shared(self, *names: int) -> AbstractContextManager[Any]:
        """A context in which the generators of the whole process are the same for both environments."""
        if self._world.draws_its_own:
            return nullcontext()
        return SharedGenerators(self._seed, "watch", *names)

    def _follow(self, episodes: Episodes, k: int, step: int, *, action: Any = None, seed: int | None = None) -> None:
        """Do in the environment that is drawn what has been done in the other one."""
        if self._twin is None:
            return
        with episodes.named(f"in step {step}"), self._shared(k, step):
            other = self._twin.env.reset(seed=seed)[0] if action is None else self._twin.env.step(action)[0]
        rows = self._world.observations.rows
        if not np.array_equal(rows(other), rows(self._seen(episodes))):
            raise PgtsError(
                f"{self._source.name} does not do the same twice, with the same seed and the same actions (step {step} "
                f"of episode {k}): its picture would be of another state than the values beside it"
            )

    def _picture(self) -> Any:
        return None if self._twin is None else self._twin.picture()


_RATE = 10.0
"""Steps a second where the environment does not say how many."""


@final
class _Twin:
    """An environment that is drawn, beside one that is not: what rendering needs is in no state that a model restores.

    env: takes the actions that the other one takes.
    """

    def __init__(self, source: EnvSource, mode: Mode, other: SyncVectorEnv) -> None:
        self._mode, self._name = mode, source.name
        modes = [str(each) for each in other.metadata.get("render_modes") or []]
        if mode not in modes and f"{mode}_list" not in modes:
            has = f"its render modes are {', '.join(modes)}" if modes else "it has no render modes"
            raise NoPicture(f"{source.name} cannot be drawn: {has}; a picture needs {mode}")
        self.env = source.like(render_mode=mode, disable_env_checker=True)  # which only repeats what it said before
        if self.env.render_mode not in (mode, f"{mode}_list"):
            raise NoPicture(
                f"{source.name} cannot be drawn: it is made with render_mode {self.env.render_mode!r}; a picture needs "
                f"{mode!r}"
            )

    def picture(self) -> Any:
        """What the environment renders; NoPicture where it cannot, and PgtsError where it fails."""
        try:
            made: Any = self.env.render()
        except (gymnasium.error.Error, ImportError) as error:
            raise NoPicture(f"{self._name} cannot be drawn: {error}") from error
        except Exception as error:
            raise failure(f"{self._name} failed in render", error) from error
        if isinstance(made, list) and made:
            made = made[-1]
        if self._mode == "ansi":
            return made if isinstance(made, str) else made.getvalue()
        picture = np.asarray(made)
        if picture.ndim != 3 or picture.shape[2] != 3 or picture.dtype != np.uint8:
            raise NoPicture(
                f"{self._name} cannot be drawn: it renders {picture.dtype} of the shape {picture.shape}; a picture is "
                "uint8 of the shape (height, width, 3)"
            )
        return picture


def _names_of(env: gymnasium.Env, world: World, own_actions: np.ndarray | None) -> list[str]:
    """What actions are called: by the table or the environment, where these have words for them."""
    count = world.num_actions
    names: Sequence[Any] = ()
    if world.mdp is not None and own_actions is None:
        names = world.mdp.action_names
    elif own_actions is None or own_actions.ndim == 1:
        for layer in (*wrappers_of(env), env.unwrapped):
            if callable(meanings := getattr(layer, "get_action_meanings", None)):
                names = meanings()
            elif members := getattr(getattr(layer, "actions", None), "__members__", None):
                names = list(members)  # of an enum, as in MiniGrid
    if own_actions is not None and (not names or own_actions.ndim > 1):
        names = [_vector(np.reshape(action, -1)) for action in own_actions]
    return [str(name).lower() for name in names] if len(names) == count else [str(a) for a in range(count)]


def _vector(values: Any, sign: str = "+") -> str:
    return " ".join(f"{x:d}" if isinstance(x, int) else f"{x:{sign}.3g}" for x in values.tolist())

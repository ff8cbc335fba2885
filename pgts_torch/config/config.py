"""The configuration of a run: all options of its training, and those of the run itself."""

import json
from typing import Annotated, Any

from pydantic import Field, ValidationInfo, model_validator

from pgts_torch.config import strict_yaml
from pgts_torch.options.arguments import described
from pgts_torch.options.fields import Count, Device, Folder, Name, Natural, Positive, checks, conflict
from pgts_torch.options.part import Part
from pgts_torch.options.training import Training


class General(Part):
    """Options of the whole run."""

    name: Name = "run"
    """The beginning of the name of the run's folder."""

    seed: Natural | None = 0
    """The seed of all random numbers; null: one is drawn, which stands in the run folder."""

    total_steps: Count = 50_000
    """Environment steps to train for."""

    device: Device = "cpu"
    """The device of policy, critic and model."""

    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    """The number of threads of torch."""


class LogConfig(Part):
    """Metrics and checkpoints."""

    every: Count = 1
    """Iterations from one line of metrics to the next."""

    exact_points: Count = 20
    """How often in a run histograms are written, and the policy is compared with the exact values of a table, where
    there is one: in so many lines of metrics, evenly over total_steps, and in the first and the last."""

    checkpoint_every: Natural = 20
    """Iterations from one checkpoint to the next, fewer where they take more than a minute; 0: only after the last, and
    where a signal ends the training."""

    keep: Count = 3
    """The number of checkpoints that are kept, the newest ones; for the best model see eval.keep_best."""


class EvalConfig(Part):
    """Evaluations of the current policy in separate episodes, with greedy and with sampled actions."""

    every: Count | None = None
    """Environment steps from one evaluation to the next; null: only after the last iteration."""

    episodes: Count = 10
    """Episodes of one evaluation."""

    stop_at_return: float | None = None
    """Training ends once greedy episodes have this mean return; null: it does not. Only with eval.every."""

    keep_best: bool = False
    """Save the model as best.pt whenever the mean return of greedy episodes is the highest so far. Only with
    eval.every."""

    @checks("stop_at_return", "keep_best")
    def _only_during_training(cls, value: Any, info: ValidationInfo) -> Any:
        if value is not None and value is not False and info.data.get("every", 1) is None:
            key = f"eval.{info.field_name}"
            raise conflict(f"{key} is {json.dumps(value)}, which needs evaluations during training; eval.every is null")
        return value


class RunConfig(Part):
    """The run folder."""

    dir: Folder | None = None
    """Its path; null: a new one in runs/, named after the run, its seed and the time."""

    overwrite: bool = False
    """Replace an earlier run in run.dir. Otherwise a run of the same configuration resumes from its last checkpoint,
    and any other is an error."""

    tensorboard: bool = True
    """Write TensorBoard events: the numbers of metrics.jsonl, hyper-parameters, histograms and pictures."""

    timeout: Positive | None = 1800
    """Seconds after which a process hangs that is still in the same call, such as a step of all its environments: it
    ends with exit code 75, and a restart goes on from the last checkpoint. Others wait for it at most twice as long;
    null: a year."""


class Config(Training, General):
    """The configuration of a run."""

    log: LogConfig = LogConfig()
    eval: EvalConfig = EvalConfig()
    run: RunConfig = RunConfig()

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, data: Any) -> Any:
        """Leave out what version 0.1 wrote as null for other kinds of search, and for the defaults of this one."""
        if not isinstance(data, dict) or not isinstance(search := data.get("search"), dict):
            return data
        kept = {name: value for name, value in search.items() if value is not None or name not in NULL_ONCE}
        return data | {"search": kept}

    def arguments(self) -> dict[str, Any]:
        """Return the arguments of `PGTS`."""
        env = dict(self.env)
        renamed = {"env": env.pop("id"), "env_kwargs": env.pop("kwargs"), "seed": self.seed, "device": self.device}
        return described(self) | env | renamed


NULL_ONCE = ("max_width", "samples", "share", "simulations", "merge")


def dump(config: Config) -> str:
    """Return all keys of the configuration as YAML, from which `load` reads the same configuration."""
    return strict_yaml.dump(_tag_first(config.model_dump(by_alias=True)))


def _tag_first(section: dict[str, Any]) -> dict[str, Any]:
    ordered = {name: section[name] for name in ("type", "kind") if name in section} | section
    return {name: _tag_first(value) if isinstance(value, dict) else value for name, value in ordered.items()}

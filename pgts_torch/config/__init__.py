"""The configuration of a run, from a YAML file and the command line. Nothing here imports torch."""

from pgts_torch.config.config import Config, dump
from pgts_torch.config.loading import ConfigError, load

__all__ = ["Config", "ConfigError", "dump", "load"]

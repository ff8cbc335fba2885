"""The comparison that users ask for, a question each.

    python benchmarks/learning.py atari         does a lookahead pay in games, against PPO at equal cost?
    python benchmarks/learning.py deep_sea      who finds the treasure, and could one have known?
    python benchmarks/learning.py learned       how soon is it solved from steps alone, with a learned model?
    python benchmarks/learning.py learned_images    and from images, with a learned model of them?
    python benchmarks/learning.py simulators    what does a call of a simulator cost beside the step of the environment?
    python benchmarks/learning.py tasks         how soon is an environment solved, against PPO, A2C and DQN?
    python benchmarks/learning.py throughput    how fast is the training, and what does a lookahead cost?
    python benchmarks/learning.py variance      what does the depth do to the gradient estimate?

What follows are the options of the script of that name: --help lists them.
"""

import argparse
import importlib

QUESTIONS = ("atari", "deep_sea", "learned", "learned_images", "simulators", "tasks", "throughput", "variance")


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter, add_help=False
    )
    parser.add_argument("question", choices=QUESTIONS)
    given, options = parser.parse_known_args()
    importlib.import_module(given.question).main(options)


if __name__ == "__main__":
    main()

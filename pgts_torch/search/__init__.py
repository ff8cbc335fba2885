"""Lookahead values at roots."""

from pgts_torch.search.expectimax import expectimax
from pgts_torch.search.lookahead import Lookahead
from pgts_torch.search.mcts import mcts
from pgts_torch.search.sampled import sampled
from pgts_torch.search.topology import Topology

__all__ = ["Lookahead", "Topology", "expectimax", "mcts", "sampled"]

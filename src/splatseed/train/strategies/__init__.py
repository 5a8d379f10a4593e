"""How Gaussians are added and removed while they are trained.

| file | role |
| --- | --- |
| ``base`` | the interface of all strategies |
| ``densification`` | gsplat's strategies, held to a cap and to the memory |
| ``growing``, ``contributions`` | splatseed's own: a budget, spent where renders are wrong |
| ``choice`` | the strategy that settings name |
"""

from splatseed.train.strategies.base import Strategy
from splatseed.train.strategies.choice import make_strategy

__all__ = ["Strategy", "make_strategy"]

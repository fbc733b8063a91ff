"""Register the environment `hma/WorldModel-v0` with gymnasium, and name what drives a world model.

The parts are in `hma_model.worlds`.
"""

from typing import TYPE_CHECKING

import gymnasium

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.worlds.env import Judge as Judge
    from hma_model.worlds.env import WorldModelEnv as WorldModelEnv
    from hma_model.worlds.env import WorldModelVectorEnv as WorldModelVectorEnv
    from hma_model.worlds.prompts import read_prompt as read_prompt
    from hma_model.worlds.prompts import starting_window as starting_window
    from hma_model.worlds.world import World as World
    from hma_model.worlds.world import load_world as load_world

__all__ = [
    "ENVIRONMENT", "Judge", "World", "WorldModelEnv", "WorldModelVectorEnv", "load_world", "read_prompt",
    "starting_window",
]  # fmt: skip
__getattr__ = lazy(
    __name__,
    {
        **dict.fromkeys(("Judge", "WorldModelEnv", "WorldModelVectorEnv"), "hma_model.worlds.env"),
        **dict.fromkeys(("World", "load_world"), "hma_model.worlds.world"),
        **dict.fromkeys(("read_prompt", "starting_window"), "hma_model.worlds.prompts"),
    },
)

ENVIRONMENT = "hma/WorldModel-v0"
gymnasium.register(
    ENVIRONMENT,
    entry_point="hma_model.worlds.env:WorldModelEnv",
    vector_entry_point="hma_model.worlds.env:WorldModelVectorEnv",
)

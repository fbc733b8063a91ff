"""Drive a world model: sessions in pictures and commands, as gymnasium environments, and in a browser.

In come a checkpoint, a prompt and commands, out come pictures. Next: `hma_model.training`.
`import hma_model.simulate` registers the environment `hma/WorldModel-v0`.
"""

from typing import TYPE_CHECKING

import gymnasium

from hma_data import lazy

if TYPE_CHECKING:
    from hma_model.simulate.env import Judge as Judge
    from hma_model.simulate.env import WorldModelEnv as WorldModelEnv
    from hma_model.simulate.env import WorldModelVectorEnv as WorldModelVectorEnv
    from hma_model.simulate.prompts import read_prompt as read_prompt
    from hma_model.simulate.prompts import starting_window as starting_window
    from hma_model.simulate.world import World as World
    from hma_model.simulate.world import load_world as load_world

__all__ = [
    "ENVIRONMENT", "Judge", "World", "WorldModelEnv", "WorldModelVectorEnv", "load_world", "read_prompt",
    "starting_window",
]  # fmt: skip
__getattr__ = lazy(
    __name__,
    {
        **dict.fromkeys(("Judge", "WorldModelEnv", "WorldModelVectorEnv"), "hma_model.simulate.env"),
        **dict.fromkeys(("World", "load_world"), "hma_model.simulate.world"),
        **dict.fromkeys(("read_prompt", "starting_window"), "hma_model.simulate.prompts"),
    },
)

ENVIRONMENT = "hma/WorldModel-v0"
gymnasium.register(
    ENVIRONMENT,
    entry_point="hma_model.simulate.env:WorldModelEnv",
    vector_entry_point="hma_model.simulate.env:WorldModelVectorEnv",
)

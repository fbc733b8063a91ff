"""Drive robots inside a world model.

In: a checkpoint, and scenes to begin in, from the laboratory's simulators or from shard sets. Out: pictures
under given commands; `hma play` shows them in a browser.
"""

"""Read recordings: one folder a format, behind the contract of `base.Source`.

In comes a file, folder or URI; out go episodes, and what an inspection of them finds. `common` holds what the
formats share. Next: `hma_data.tokenizers`.
"""

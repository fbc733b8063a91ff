"""Train and measure the embedded tokenizers: `hma tokenizer train` and `hma tokenizer eval`."""

"""Tokenizers by name; the module of each is imported on use."""

from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer

__all__ = ["Tokenizer", "TokenizerSpec", "get_tokenizer"]

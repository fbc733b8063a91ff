"""Offer tokenizers by name. The module of a tokenizer is imported when it is first used."""

from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer

__all__ = ["Tokenizer", "TokenizerSpec", "get_tokenizer"]

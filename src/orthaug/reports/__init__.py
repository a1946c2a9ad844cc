"""Results in words, pictures and on a page; nothing is computed here."""

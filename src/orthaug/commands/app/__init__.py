"""`orthaug app`: a local page on which a spec is made, checked, trained and read.

The page never computes by itself: data are looked at, and specs are checked, trained and exported,
in processes of their own that do what the command line does.
"""

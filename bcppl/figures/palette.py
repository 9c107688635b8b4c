"""Colours of Okabe and Ito's palette, which differ for every kind of colour vision, and quiet ones."""

STRONG = "#D55E00"  # the mean, and what is heavy
TRUTH = "#00A6D6"
SEEN = "#0072B2"  # a second belief: as seen from the held peg
FELT = "#CC79A7"  # contact
PARTICLE = "#7F7F7F"
BODY = "#9DB4C8"

"""Dead bands: commands that reverse and travel on while their joint stands still.

Dry friction (stick) and a gear's play both do that at every reversal, and both are mechanics: the
joint is measured rightly, and its gain and lag stand. Here the width of the band is measured.
"""

"""Analysis of object tables against the truth and between surveys: samples, groups, blends, shear, differences."""

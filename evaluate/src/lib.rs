//! How good a result is: depth error, DTU distances, Tanks and Temples F-score.

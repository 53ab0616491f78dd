"""Problems of few rows: look, solve and judge in one compiled call."""

"""Problems with a reason, measuring and reporting, and what examines a problem or an answer."""

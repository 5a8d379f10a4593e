"""While a benchmark runs: the ledger, the executors, and one run from its seeds to its result."""

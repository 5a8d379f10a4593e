"""While a benchmark runs: the ledger, the executors, one run from its seeds to what is kept."""

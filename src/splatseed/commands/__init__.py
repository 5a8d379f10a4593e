"""What each verb of the command line does; ``cli`` only finds the verb and reports errors."""

"""What stands around the pile, and who digs."""

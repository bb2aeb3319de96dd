"""What moving costs: energies by joint and cycle, cost of transport, closure of the balance."""

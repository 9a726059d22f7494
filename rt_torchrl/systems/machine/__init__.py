"""Machines behind OPC UA and Modbus as real systems, and a rehearsal; see docs/connect_your_machine.md."""

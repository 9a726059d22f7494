"""Machines behind OPC UA and Modbus as real systems; see docs/connect_your_machine.md."""

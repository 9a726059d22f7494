"""What plants speak, OPC UA and Modbus, behind the contract of a real system; see docs/connect_your_machine.md."""

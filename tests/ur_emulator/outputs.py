"""Names and types of what a controller sends and takes; from the manufacturer's RTDE guide."""

from __future__ import annotations

_JOINTS = (
    "target_q target_qd target_qdd target_current target_moment actual_q actual_qd actual_current joint_control_output "
    "actual_TCP_pose actual_TCP_speed actual_TCP_force target_TCP_pose target_TCP_speed joint_temperatures "
    "actual_joint_voltage ft_raw_wrench payload_inertia tcp_offset"
)
_NUMBERS = (
    "timestamp actual_execution_time speed_scaling target_speed_fraction actual_momentum actual_main_voltage "
    "actual_robot_voltage actual_robot_current standard_analog_input0 standard_analog_input1 standard_analog_output0 "
    "standard_analog_output1 io_current payload tool_output_current tool_temperature"
)

TYPES = (
    dict.fromkeys(_JOINTS.split(), "VECTOR6D")
    | dict.fromkeys(_NUMBERS.split(), "DOUBLE")
    | dict.fromkeys(
        ("actual_tool_accelerometer", "payload_cog", "elbow_position", "elbow_velocity"), "VECTOR3D"
    )
    | dict.fromkeys(("robot_mode", "safety_mode", "safety_status"), "INT32")
    | dict.fromkeys(("runtime_state", "robot_status_bits", "safety_status_bits"), "UINT32")
    | dict.fromkeys(("actual_digital_input_bits", "actual_digital_output_bits"), "UINT64")
    | {"joint_mode": "VECTOR6INT32"}
    | {f"output_int_register_{i}": "INT32" for i in range(48)}
    | {f"output_double_register_{i}": "DOUBLE" for i in range(48)}
    | {f"output_bit_register_{i}": "BOOL" for i in range(64, 128)}
)

_INPUTS = {
    "speed_slider_mask": "UINT32",
    "speed_slider_fraction": "DOUBLE",
    "standard_digital_output_mask": "UINT8",
    "standard_digital_output": "UINT8",
    "configurable_digital_output_mask": "UINT8",
    "configurable_digital_output": "UINT8",
    "tool_digital_output_mask": "UINT8",
    "tool_digital_output": "UINT8",
    "standard_analog_output_mask": "UINT8",
    "standard_analog_output_type": "UINT8",
    "standard_analog_output_0": "DOUBLE",
    "standard_analog_output_1": "DOUBLE",
    "external_force_torque": "VECTOR6D",
}


def input_type(name: str) -> str:
    """Type of an input, or ``NOT_FOUND``."""
    stem, _, number = name.rpartition("_")
    if number.isdigit() and int(number) < 48:
        registers = {"input_int_register": "INT32", "input_double_register": "DOUBLE"}
        if stem in registers:
            return registers[stem]
    return _INPUTS.get(name, "NOT_FOUND")

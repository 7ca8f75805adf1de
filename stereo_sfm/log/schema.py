"""Dataclasses as protobuf messages: the schema is made from the dataclass, arrays cross as blocks of bytes.

An array field is declared as a packed `repeated double` (float, sfixed64, sfixed32, bool), so that every
viewer shows numbers. On the wire a packed field of fixed-size numbers is the same as a `bytes` field holding the array
in little-endian order (protobuf encoding guide, "packed repeated fields"; a bool is a one-byte varint). So our own
code reads and writes a twin message in which those fields are `bytes`: one memory copy, no Python loop.
"""

from __future__ import annotations

import dataclasses
import enum
import functools
import types
import typing
from collections.abc import Callable
from typing import Any

import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
from google.protobuf.message import DecodeError
from numpy.typing import NDArray

from stereo_sfm.errors import StereoSfmError

PACKAGE = "stereo_sfm"

_F = descriptor_pb2.FieldDescriptorProto
_ARRAYS: dict[str, int] = {
    "float64": _F.TYPE_DOUBLE,
    "float32": _F.TYPE_FLOAT,
    "int64": _F.TYPE_SFIXED64,
    "int32": _F.TYPE_SFIXED32,
    "bool": _F.TYPE_BOOL,
    "uint8": _F.TYPE_BYTES,
}
_SCALARS: dict[Any, int] = {
    int: _F.TYPE_SINT64,
    float: _F.TYPE_DOUBLE,
    bool: _F.TYPE_BOOL,
    str: _F.TYPE_STRING,
}


@dataclasses.dataclass(frozen=True)
class _Field:
    name: str
    kind: str  # "array", "scalar", "enum", "message", "numbers" (dict), "rows" (tuple of tuples)
    proto: int  # type of the scalar or of the array's items
    dtype: str = ""
    stored: Any = None  # dtype of the array in the file
    shape: tuple[int, ...] = (-1,)  # of the array: `stereo_sfm.types.shape` in the field's metadata
    convert: Any = None  # enum class, nested dataclass, or the types of a row's items
    optional: bool = False  # a nested dataclass that may be None


def _array_dtype(annotation: Any) -> str | None:
    """Name of the dtype of an NDArray annotation, None for anything else."""
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is np.ndarray:  # up to numpy 2.4
        (dtype,) = typing.get_args(arguments[1])
    elif origin is NDArray:  # an alias with a name of its own
        (dtype,) = arguments
    else:
        return None
    return np.dtype(dtype).name


def _describe(field: dataclasses.Field[Any], annotation: Any) -> _Field:
    name = field.name
    optional = isinstance(annotation, types.UnionType)
    if optional:
        annotation = next(a for a in annotation.__args__ if a is not type(None))
    dtype = _array_dtype(annotation)
    if dtype is not None:
        stored = np.dtype(dtype).newbyteorder("<")
        return _Field(name, "array", _ARRAYS[dtype], dtype, stored, field.metadata.get("shape", (-1,)))
    if annotation in _SCALARS:
        return _Field(name, "scalar", _SCALARS[annotation])
    origin = typing.get_origin(annotation)
    if origin is dict:
        return _Field(name, "numbers", _F.TYPE_DOUBLE)
    if origin is tuple:
        return _Field(name, "rows", _F.TYPE_MESSAGE, convert=typing.get_args(typing.get_args(annotation)[0]))
    if isinstance(annotation, type) and issubclass(annotation, enum.IntEnum):
        return _Field(name, "enum", _F.TYPE_SINT64, convert=annotation)
    if dataclasses.is_dataclass(annotation):
        return _Field(name, "message", _F.TYPE_MESSAGE, convert=annotation, optional=optional)
    raise TypeError(f"no protobuf form for {name}: {annotation}")


@functools.cache
def fields_of(cls: type[Any]) -> tuple[_Field, ...]:
    """The fields of a dataclass as they are encoded."""
    hints = typing.get_type_hints(cls)
    return tuple(_describe(f, hints[f.name]) for f in dataclasses.fields(cls))


def _add(
    message: descriptor_pb2.DescriptorProto, name: str, kind: int, repeated: bool = False, type_name: str = ""
) -> None:
    label = _F.LABEL_REPEATED if repeated else _F.LABEL_OPTIONAL
    field = message.field.add(name=name, number=len(message.field) + 1, type=kind, label=label)
    if type_name:
        field.type_name = type_name


def _fill(message: descriptor_pb2.DescriptorProto, cls: type[Any], twin: bool, prefix: str) -> None:
    """Fields of `cls`, nested types inside. `prefix` is the message's full name with a leading dot."""
    for f in fields_of(cls):
        if f.kind == "array":
            as_bytes = twin or f.proto == _F.TYPE_BYTES
            _add(message, f.name, _F.TYPE_BYTES if as_bytes else f.proto, repeated=not as_bytes)
        elif f.kind in ("scalar", "enum"):
            _add(message, f.name, f.proto)
        elif f.kind == "numbers":
            _add(message, f"{f.name}_names", _F.TYPE_STRING, repeated=True)
            _add(message, f"{f.name}_values", _F.TYPE_DOUBLE, repeated=True)
        elif f.kind == "rows":
            row = message.nested_type.add(name=f"{f.name.title()}Row")
            for i, item in enumerate(f.convert):
                _add(row, f"item{i}", _SCALARS[item])
            _add(message, f.name, _F.TYPE_MESSAGE, repeated=True, type_name=f"{prefix}.{row.name}")
        else:
            name = f.convert.__name__
            if all(known.name != name for known in message.nested_type):  # several fields may have one type
                _fill(message.nested_type.add(name=name), f.convert, twin, f"{prefix}.{name}")
            _add(message, f.name, _F.TYPE_MESSAGE, type_name=f"{prefix}.{name}")


def _file(cls: type[Any], twin: bool) -> descriptor_pb2.FileDescriptorProto:
    name = cls.__name__
    file = descriptor_pb2.FileDescriptorProto(name=f"{PACKAGE}/{name}.proto", package=PACKAGE, syntax="proto3")
    _fill(file.message_type.add(name=name), cls, twin, f".{PACKAGE}.{name}")
    return file


def _class_from(file: descriptor_pb2.FileDescriptorProto, full_name: str) -> type[Any]:
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName(full_name))


@functools.cache
def _twin(cls: type[Any]) -> type[Any]:
    return _class_from(_file(cls, twin=True), full_name(cls))


def full_name(cls: type[Any]) -> str:
    """`stereo_sfm.Frame` for `Frame`."""
    return f"{PACKAGE}.{cls.__name__}"


@functools.cache
def schema_data(cls: type[Any]) -> bytes:
    """The serialised FileDescriptorSet that goes into the MCAP schema record."""
    return descriptor_pb2.FileDescriptorSet(file=[_file(cls, twin=False)]).SerializeToString()


def _write(message: Any, obj: Any) -> None:
    for f in fields_of(type(obj)):
        value = getattr(obj, f.name)
        if value is None:
            continue
        if f.kind == "array":
            setattr(message, f.name, np.asarray(value, f.stored).tobytes())
        elif f.kind == "scalar":
            setattr(message, f.name, value)
        elif f.kind == "enum":
            setattr(message, f.name, int(value))
        elif f.kind == "numbers":
            getattr(message, f"{f.name}_names").extend(value)
            getattr(message, f"{f.name}_values").extend(value.values())
        elif f.kind == "rows":
            for row in value:
                getattr(message, f.name).add(**{f"item{i}": item for i, item in enumerate(row)})
        else:
            _write(getattr(message, f.name), value)


def encode(obj: Any) -> bytes:
    """A dataclass instance as the bytes of its protobuf message."""
    message = _twin(type(obj))()
    _write(message, obj)
    return message.SerializeToString()


def _read_array(data: bytes, f: _Field) -> np.ndarray[Any, Any]:
    flat = np.frombuffer(data, f.stored).astype(f.dtype)
    return flat.reshape(f.shape)


def _read(message: Any, cls: type[Any]) -> Any:
    values: dict[str, Any] = {}
    present = message.DESCRIPTOR.fields_by_name
    for f in fields_of(cls):
        key = f"{f.name}_names" if f.kind == "numbers" else f.name
        if key not in present:
            continue  # a log written before the field existed: the dataclass's default
        if f.kind == "array":
            values[f.name] = _read_array(getattr(message, f.name), f)
        elif f.kind == "scalar":
            values[f.name] = getattr(message, f.name)
        elif f.kind == "enum":
            values[f.name] = f.convert(getattr(message, f.name))
        elif f.kind == "numbers":
            names, numbers = getattr(message, key), getattr(message, f"{f.name}_values")
            values[f.name] = dict(zip(names, numbers, strict=True))
        elif f.kind == "rows":
            rows = getattr(message, f.name)
            values[f.name] = tuple(tuple(getattr(r, f"item{i}") for i in range(len(f.convert))) for r in rows)
        elif f.optional and not message.HasField(f.name):
            values[f.name] = None
        else:
            values[f.name] = _read(getattr(message, f.name), f.convert)
    return cls(**values)


def _bytes_for_arrays(message: descriptor_pb2.DescriptorProto) -> None:
    """Turn the packed numbers of a schema into `bytes`, except lists of values that belong to names."""
    for field in message.field:
        packed = field.label == _F.LABEL_REPEATED and field.type in _ARRAYS.values()
        if packed and not field.name.endswith("_values"):
            field.label, field.type = _F.LABEL_OPTIONAL, _F.TYPE_BYTES
    for nested in message.nested_type:
        _bytes_for_arrays(nested)


def decoder(cls: type[Any], schema: bytes) -> Callable[[bytes], Any]:
    """A function from message bytes to `cls`, by the field names of the schema in the file.

    Args:
        cls: the dataclass.
        schema: serialised FileDescriptorSet from the file, possibly of another version of this package.

    Raises:
        ValueError: the schema is damaged; the function raises it for damaged messages.
    """
    try:
        (file,) = descriptor_pb2.FileDescriptorSet.FromString(schema).file
        for message in file.message_type:
            _bytes_for_arrays(message)
        message_class = _class_from(file, full_name(cls))
    except (DecodeError, ValueError, TypeError, LookupError):
        raise ValueError(f"the schema of {cls.__name__} messages is damaged") from None

    def decode(data: bytes) -> Any:
        try:
            return _read(message_class.FromString(data), cls)
        except (DecodeError, ValueError, LookupError, OverflowError):
            raise ValueError(f"a damaged {cls.__name__} message") from None
        except TypeError as error:
            raise StereoSfmError(
                f"{cls.__name__} in this log was written by another version of stereo-sfm, use that one: {error}"
            ) from None

    return decode

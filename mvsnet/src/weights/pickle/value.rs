//! What a pickle of weights can hold.

use std::rc::Rc;

/// The element type of a storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::weights) enum ElementType {
    F16,
    Bf16,
    F32,
    F64,
    /// Integers and booleans, of so many bytes; counters, never weights.
    Integer(usize),
}

impl ElementType {
    pub(in crate::weights) fn bytes(self) -> usize {
        match self {
            Self::F16 | Self::Bf16 => 2,
            Self::F32 => 4,
            Self::F64 => 8,
            Self::Integer(bytes) => bytes,
        }
    }
}

/// A block of elements that lies outside the pickle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::weights) struct Storage {
    pub(in crate::weights) element: ElementType,
    pub(in crate::weights) len: usize,
}

/// A view into a storage; sizes and strides in elements, not checked against the storage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::weights) struct TensorRef {
    pub(in crate::weights) storage: Rc<str>,
    pub(in crate::weights) offset: usize,
    pub(in crate::weights) shape: Vec<usize>,
    pub(in crate::weights) strides: Vec<usize>,
}

/// The names a pickle may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::weights) enum Global {
    /// `collections.OrderedDict`, `collections.defaultdict`, `dict`: all become dictionaries.
    Dict,
    RebuildTensor,
    RebuildParameter,
    Size,
    Storage(ElementType),
}

impl Global {
    pub(super) fn named(module: &str, name: &str) -> Option<Self> {
        Some(match (module, name) {
            ("collections", "OrderedDict" | "defaultdict") | ("builtins" | "__builtin__", "dict") => {
                Self::Dict
            }
            ("torch._utils", "_rebuild_tensor_v2") => Self::RebuildTensor,
            ("torch._utils", "_rebuild_parameter") => Self::RebuildParameter,
            ("torch", "Size") => Self::Size,
            ("torch", "HalfStorage") => Self::Storage(ElementType::F16),
            ("torch", "BFloat16Storage") => Self::Storage(ElementType::Bf16),
            ("torch", "FloatStorage") => Self::Storage(ElementType::F32),
            ("torch", "DoubleStorage") => Self::Storage(ElementType::F64),
            ("torch", "LongStorage") => Self::Storage(ElementType::Integer(8)),
            ("torch", "IntStorage") => Self::Storage(ElementType::Integer(4)),
            ("torch", "ShortStorage") => Self::Storage(ElementType::Integer(2)),
            ("torch", "CharStorage" | "ByteStorage" | "BoolStorage") => {
                Self::Storage(ElementType::Integer(1))
            }
            _ => return None,
        })
    }
}

/// What a pickle builds; containers are indices into the arenas of [`Pickle`].
#[derive(Clone, Debug, PartialEq)]
pub(in crate::weights) enum Value {
    None,
    Bool(bool),
    Int(i128),
    Float,
    Str(Rc<str>),
    Tuple(usize),
    List(usize),
    Dict(usize),
    Global(Global),
    Storage(Rc<str>),
    Tensor(Rc<TensorRef>),
}

impl Value {
    pub(super) fn as_size(&self) -> Option<usize> {
        match self {
            Self::Int(value) => usize::try_from(*value).ok(),
            _ => None,
        }
    }
}
/// The containers of a pickle, flat.
#[derive(Debug, Default)]
pub(super) struct Arena {
    pub(super) sequences: Vec<Vec<Value>>,
    pub(super) dicts: Vec<Vec<(Value, Value)>>,
}

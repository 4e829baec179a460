//! A pickle interpreter that can build numbers, strings, lists, dictionaries and descriptions of
//! tensors, and nothing else.
//!
//! Python's own reader imports and calls whatever a pickle names. This one knows the few names that
//! PyTorch writes into checkpoints and refuses every other by name, so no file can run code. Containers live in
//! flat arenas, so no nesting depth can exhaust the stack when they are dropped.

use std::collections::{BTreeMap, HashMap};
use std::rc::Rc;

use thiserror::Error;

/// Far more than any checkpoint of this network needs (the reference's has 9000 with its optimiser).
const MAX_INSTRUCTIONS: usize = 2_000_000;

/// Why a pickle is refused. Offsets are in bytes from the start of the pickle.
#[derive(Debug, Error, PartialEq, Eq)]
pub enum PickleError {
    /// The bytes end within an instruction.
    #[error("pickle is truncated at byte {at}")]
    Truncated {
        /// Where.
        at: usize,
    },
    /// It names a function or class that tensors do not need.
    #[error("pickle asks for \"{name}\" at byte {at}, which no weights need; nothing was executed")]
    Forbidden {
        /// The function or class.
        name: String,
        /// Where.
        at: usize,
    },
    /// It holds an instruction that checkpoints do not use.
    #[error("pickle instruction {opcode:#04x} at byte {at} is none that weights need")]
    UnknownInstruction {
        /// The instruction.
        opcode: u8,
        /// Where.
        at: usize,
    },
    /// Its instructions do not fit together.
    #[error("pickle is malformed at byte {at}: {what}")]
    Malformed {
        /// Where.
        at: usize,
        /// What is wrong.
        what: &'static str,
    },
    /// It is too long.
    #[error("pickle has more than {MAX_INSTRUCTIONS} instructions")]
    TooLong,
}

/// The element type of a storage.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum ElementType {
    F16,
    Bf16,
    F32,
    F64,
    /// Integers and booleans, of so many bytes; counters, never weights.
    Integer(usize),
}

impl ElementType {
    pub(super) fn bytes(self) -> usize {
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
pub(super) struct Storage {
    pub(super) element: ElementType,
    pub(super) len: usize,
}

/// A view into a storage; sizes and strides in elements, not checked against the storage.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct TensorRef {
    pub(super) storage: Rc<str>,
    pub(super) offset: usize,
    pub(super) shape: Vec<usize>,
    pub(super) strides: Vec<usize>,
}

/// The names a pickle may use.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Global {
    /// `collections.OrderedDict`, `collections.defaultdict`, `dict`: all become dictionaries.
    Dict,
    RebuildTensor,
    RebuildParameter,
    Size,
    Storage(ElementType),
}

impl Global {
    fn named(module: &str, name: &str) -> Option<Self> {
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
pub(super) enum Value {
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
    fn as_size(&self) -> Option<usize> {
        match self {
            Self::Int(value) => usize::try_from(*value).ok(),
            _ => None,
        }
    }
}

/// A finished pickle.
#[derive(Debug)]
pub(super) struct Pickle {
    pub(super) root: Value,
    /// Every storage that the pickle refers to, by key.
    pub(super) storages: BTreeMap<Rc<str>, Storage>,
    /// Bytes read, up to and including the last instruction.
    pub(super) bytes: usize,
    arena: Arena,
}

#[derive(Debug, Default)]
struct Arena {
    sequences: Vec<Vec<Value>>,
    dicts: Vec<Vec<(Value, Value)>>,
}

impl Pickle {
    /// Interprets the pickle that `bytes` start with.
    pub(super) fn read(bytes: &[u8]) -> Result<Self, PickleError> {
        let mut machine = Machine {
            bytes,
            at: 0,
            instruction_at: 0,
            stack: Vec::new(),
            marks: Vec::new(),
            memo: HashMap::new(),
            storages: BTreeMap::new(),
            arena: Arena::default(),
        };
        for _ in 0..MAX_INSTRUCTIONS {
            machine.instruction_at = machine.at;
            if let Some(root) = machine.step()? {
                let Machine { at, storages, arena, .. } = machine;
                return Ok(Self { root, storages, bytes: at, arena });
            }
        }
        Err(PickleError::TooLong)
    }

    /// The items of a list or tuple.
    pub(super) fn sequence(&self, value: &Value) -> Option<&[Value]> {
        match value {
            Value::List(index) | Value::Tuple(index) => Some(&self.arena.sequences[*index]),
            _ => None,
        }
    }

    /// The entries of a dictionary whose keys are strings, in the order of the file.
    pub(super) fn entries(&self, value: &Value) -> Option<impl Iterator<Item = (&Rc<str>, &Value)>> {
        let Value::Dict(index) = value else { return None };
        Some(self.arena.dicts[*index].iter().filter_map(|(key, value)| match key {
            Value::Str(key) => Some((key, value)),
            _ => None,
        }))
    }

    /// The value at a key of a dictionary.
    pub(super) fn get(&self, value: &Value, key: &str) -> Option<&Value> {
        self.entries(value)?.find_map(|(name, value)| (&**name == key).then_some(value))
    }
}

struct Machine<'a> {
    bytes: &'a [u8],
    at: usize,
    instruction_at: usize,
    stack: Vec<Value>,
    /// Heights of the stack at each mark; values below the last are out of reach.
    marks: Vec<usize>,
    memo: HashMap<u64, Value>,
    storages: BTreeMap<Rc<str>, Storage>,
    arena: Arena,
}

impl Machine<'_> {
    /// Carries out one instruction; the root at the last one.
    fn step(&mut self) -> Result<Option<Value>, PickleError> {
        let opcode = self.unsigned(1)? as u8;
        match opcode {
            0x80 => drop(self.unsigned(1)?), // PROTO
            0x95 => drop(self.unsigned(8)?), // FRAME
            b'.' => return self.pop().map(Some),
            b'(' => self.marks.push(self.stack.len()),
            b'}' => self.push_dict(),
            b']' => self.push_list(Vec::new()),
            b')' => self.push_tuple(Vec::new()),
            b'N' => self.stack.push(Value::None),
            0x88 => self.stack.push(Value::Bool(true)),
            0x89 => self.stack.push(Value::Bool(false)),
            b'K' => {
                let value = self.unsigned(1)?;
                self.stack.push(Value::Int(value as i128));
            }
            b'M' => {
                let value = self.unsigned(2)?;
                self.stack.push(Value::Int(value as i128));
            }
            b'J' => {
                let value = self.unsigned(4)? as u32 as i32;
                self.stack.push(Value::Int(value as i128));
            }
            0x8a => self.long()?,
            b'G' => {
                self.unsigned(8)?;
                self.stack.push(Value::Float);
            }
            0x8c => self.string(1)?,
            b'X' => self.string(4)?,
            b'q' => self.memoize(1)?,
            b'r' => self.memoize(4)?,
            0x94 => self.keep(self.memo.len() as u64)?,
            b'h' => self.recall(1)?,
            b'j' => self.recall(4)?,
            b't' => {
                let items = self.pop_to_mark()?;
                self.push_tuple(items);
            }
            0x85..=0x87 => {
                let mut items = Vec::new();
                for _ in 0..=(opcode - 0x85) {
                    items.insert(0, self.pop()?);
                }
                self.push_tuple(items);
            }
            b'a' => {
                let item = self.pop()?;
                self.append(vec![item])?;
            }
            b'e' => {
                let items = self.pop_to_mark()?;
                self.append(items)?;
            }
            b's' => {
                let (value, key) = (self.pop()?, self.pop()?);
                self.insert(vec![key, value])?;
            }
            b'u' => {
                let items = self.pop_to_mark()?;
                self.insert(items)?;
            }
            b'c' => {
                let (module, name) = (self.line()?, self.line()?);
                self.push_global(&module, &name)?;
            }
            0x93 => match (self.pop()?, self.pop()?) {
                (Value::Str(name), Value::Str(module)) => self.push_global(&module, &name)?,
                _ => return Err(self.malformed("the name of a class is no string")),
            },
            b'Q' => self.persistent_id()?,
            b'R' => self.reduce()?,
            // Attributes of an OrderedDict (`_metadata`); no value here has attributes.
            b'b' => match (self.pop()?, self.stack.last()) {
                (_, Some(Value::Dict(_))) => {}
                _ => return Err(self.malformed("attributes for what is no dictionary")),
            },
            opcode => return Err(PickleError::UnknownInstruction { opcode, at: self.instruction_at }),
        }
        Ok(None)
    }

    fn malformed(&self, what: &'static str) -> PickleError {
        PickleError::Malformed { at: self.instruction_at, what }
    }

    fn slice(&mut self, len: usize) -> Result<&[u8], PickleError> {
        let end = self.at.checked_add(len).filter(|end| *end <= self.bytes.len());
        let end = end.ok_or(PickleError::Truncated { at: self.bytes.len() })?;
        let slice = &self.bytes[self.at..end];
        self.at = end;
        Ok(slice)
    }

    /// A number of at most eight bytes, little endian.
    fn unsigned(&mut self, width: usize) -> Result<u64, PickleError> {
        Ok(self.slice(width)?.iter().rev().fold(0, |number, byte| number << 8 | *byte as u64))
    }

    fn line(&mut self) -> Result<String, PickleError> {
        let len = self.bytes[self.at..].iter().position(|byte| *byte == b'\n');
        let len = len.ok_or(PickleError::Truncated { at: self.bytes.len() })?;
        let line = String::from_utf8_lossy(self.slice(len)?).into_owned();
        self.at += 1;
        Ok(line)
    }

    /// A string after its length of so many bytes.
    fn string(&mut self, width: usize) -> Result<(), PickleError> {
        let len = usize::try_from(self.unsigned(width)?).unwrap_or(usize::MAX);
        let text = str::from_utf8(self.slice(len)?).map(Rc::from);
        let text = text.map_err(|_| self.malformed("a string is not UTF-8"))?;
        self.stack.push(Value::Str(text));
        Ok(())
    }

    /// LONG1: two's complement of up to 255 bytes, little endian; sixteen are plenty.
    fn long(&mut self) -> Result<(), PickleError> {
        let len = self.unsigned(1)?;
        if len > 16 {
            return Err(self.malformed("an integer of more than 16 bytes"));
        }
        let digits = self.slice(len as usize)?;
        let fill = if digits.last().is_some_and(|byte| byte & 0x80 != 0) { 0xff } else { 0 };
        let mut bytes = [fill; 16];
        bytes[..digits.len()].copy_from_slice(digits);
        self.stack.push(Value::Int(i128::from_le_bytes(bytes)));
        Ok(())
    }

    fn pop(&mut self) -> Result<Value, PickleError> {
        let floor = self.marks.last().copied().unwrap_or(0);
        if self.stack.len() <= floor {
            return Err(self.malformed("the stack is empty"));
        }
        self.stack.pop().ok_or_else(|| self.malformed("the stack is empty"))
    }

    fn pop_to_mark(&mut self) -> Result<Vec<Value>, PickleError> {
        let mark = self.marks.pop().ok_or_else(|| self.malformed("there is no mark"))?;
        Ok(self.stack.split_off(mark))
    }

    fn push_dict(&mut self) {
        self.stack.push(Value::Dict(self.arena.dicts.len()));
        self.arena.dicts.push(Vec::new());
    }

    fn push_list(&mut self, items: Vec<Value>) {
        self.stack.push(Value::List(self.arena.sequences.len()));
        self.arena.sequences.push(items);
    }

    fn push_tuple(&mut self, items: Vec<Value>) {
        self.stack.push(Value::Tuple(self.arena.sequences.len()));
        self.arena.sequences.push(items);
    }

    fn push_global(&mut self, module: &str, name: &str) -> Result<(), PickleError> {
        let global = Global::named(module, name).ok_or_else(|| PickleError::Forbidden {
            name: format!("{module}.{name}"),
            at: self.instruction_at,
        })?;
        self.stack.push(Value::Global(global));
        Ok(())
    }

    /// Keeps the topmost value under a key of so many bytes.
    fn memoize(&mut self, width: usize) -> Result<(), PickleError> {
        let key = self.unsigned(width)?;
        self.keep(key)
    }

    fn keep(&mut self, key: u64) -> Result<(), PickleError> {
        let value = self.stack.last().cloned().ok_or_else(|| self.malformed("the stack is empty"))?;
        self.memo.insert(key, value);
        Ok(())
    }

    /// Puts the value that was kept under a key of so many bytes on the stack.
    fn recall(&mut self, width: usize) -> Result<(), PickleError> {
        let key = self.unsigned(width)?;
        let value = self.memo.get(&key).cloned();
        let value = value.ok_or_else(|| self.malformed("a value is recalled that was never kept"))?;
        self.stack.push(value);
        Ok(())
    }

    fn append(&mut self, items: Vec<Value>) -> Result<(), PickleError> {
        match self.stack.last() {
            Some(Value::List(index)) => self.arena.sequences[*index].extend(items),
            _ => return Err(self.malformed("items for what is no list")),
        }
        Ok(())
    }

    fn insert(&mut self, items: Vec<Value>) -> Result<(), PickleError> {
        let Some(Value::Dict(index)) = self.stack.last() else {
            return Err(self.malformed("entries for what is no dictionary"));
        };
        if !items.len().is_multiple_of(2) {
            return Err(self.malformed("a key without a value"));
        }
        let mut items = items.into_iter();
        while let (Some(key), Some(value)) = (items.next(), items.next()) {
            self.arena.dicts[*index].push((key, value));
        }
        Ok(())
    }

    /// `("storage", type, key, location, length)`, and a view in old files, which must be none.
    fn persistent_id(&mut self) -> Result<(), PickleError> {
        let Value::Tuple(index) = self.pop()? else {
            return Err(self.malformed("a reference to a storage is no tuple"));
        };
        match self.arena.sequences[index].as_slice() {
            [
                Value::Str(tag),
                Value::Global(Global::Storage(element)),
                Value::Str(key),
                _,
                len,
                view @ ..,
            ] if &**tag == "storage" && matches!(view, [] | [Value::None]) => {
                let len = len.as_size().ok_or_else(|| self.malformed("the length of a storage"))?;
                let storage = Storage { element: *element, len };
                if *self.storages.entry(key.clone()).or_insert(storage) != storage {
                    return Err(self.malformed("two descriptions of one storage"));
                }
                self.stack.push(Value::Storage(key.clone()));
                Ok(())
            }
            _ => Err(self.malformed("a reference to what is no storage")),
        }
    }

    /// A call of one of the allowed names.
    fn reduce(&mut self) -> Result<(), PickleError> {
        let (arguments, callee) = (self.pop()?, self.pop()?);
        let (Value::Tuple(index), Value::Global(global)) = (arguments, callee) else {
            return Err(self.malformed("a call of what is no function"));
        };
        let arguments = &self.arena.sequences[index];
        match (global, arguments.as_slice()) {
            (Global::Dict, [] | [Value::Global(Global::Dict)]) => self.push_dict(),
            (Global::RebuildParameter, [tensor @ Value::Tensor(_), ..])
            | (Global::Size, [tensor @ Value::Tuple(_)]) => {
                let value = tensor.clone();
                self.stack.push(value);
            }
            (
                Global::RebuildTensor,
                [Value::Storage(storage), offset, Value::Tuple(shape), Value::Tuple(strides), ..],
            ) => {
                let sizes = |index: &usize| self.arena.sequences[*index].iter().map(Value::as_size).collect();
                let tensor = offset.as_size().zip(sizes(shape)).zip(sizes(strides));
                let ((offset, shape), strides) =
                    tensor.ok_or_else(|| self.malformed("the size of a tensor"))?;
                let storage = storage.clone();
                self.stack.push(Value::Tensor(Rc::new(TensorRef { storage, offset, shape, strides })));
            }
            _ => return Err(self.malformed("a call with unknown arguments")),
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    #[test]
    fn code_is_refused_by_name_and_not_run() {
        // What `pickle.dumps` makes of an object whose `__reduce__` is `(os.system, ("true",))`.
        let bytes = b"\x80\x02cposix\nsystem\nq\x00X\x04\x00\x00\x00trueq\x01\x85q\x02Rq\x03.";
        let error = Pickle::read(bytes).expect_err("code");
        assert_eq!(error, PickleError::Forbidden { name: "posix.system".into(), at: 2 });
        let bytes = b"\x80\x04\x8c\x08builtins\x8c\x04eval\x93.";
        let error = Pickle::read(bytes).expect_err("code");
        assert_eq!(error, PickleError::Forbidden { name: "builtins.eval".into(), at: 18 });
    }

    #[test]
    fn containers_are_filled_after_they_were_kept() {
        let bytes = b"\x80\x02}q\x00(X\x01\x00\x00\x00aK\x05X\x01\x00\x00\x00b]q\x01(K\x01M\x00\x02eu.";
        let pickle = Pickle::read(bytes).expect("a dictionary");
        assert_eq!(pickle.get(&pickle.root, "a"), Some(&Value::Int(5)));
        let list = pickle.get(&pickle.root, "b").expect("an entry");
        assert_eq!(pickle.sequence(list), Some(&[Value::Int(1), Value::Int(512)][..]));
        assert_eq!(pickle.bytes, bytes.len());
    }

    #[test]
    fn big_integers_keep_their_sign() {
        let pickle = Pickle::read(b"\x8a\x0a\x6c\xfc\x9c\x46\xf9\x20\x6a\xa8\x50\x19.").expect("a number");
        assert_eq!(pickle.root, Value::Int(0x1950_a86a_20f9_469c_fc6c));
        assert_eq!(Pickle::read(b"\x8a\x01\xff.").expect("a number").root, Value::Int(-1));
    }

    #[test]
    fn lengths_beyond_the_file_allocate_nothing() {
        let error = Pickle::read(b"X\xff\xff\xff\xffabc").expect_err("a string of 4 GiB");
        assert_eq!(error, PickleError::Truncated { at: 8 });
    }

    #[test]
    fn nesting_does_not_exhaust_the_stack() {
        let mut bytes = vec![b')'];
        bytes.resize(1_000_000, 0x85);
        bytes.push(b'.');
        assert!(Pickle::read(&bytes).is_ok());
        bytes.insert(0, b'(');
        assert!(matches!(Pickle::read(&vec![b'N'; MAX_INSTRUCTIONS + 1]), Err(PickleError::TooLong)));
    }

    proptest! {
        #[test]
        fn arbitrary_bytes_do_not_panic(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            let _ = Pickle::read(&bytes);
        }

        #[test]
        fn arbitrary_instructions_do_not_panic(
            picks in proptest::collection::vec(proptest::sample::select(b"}])(NtaesuRQbqhK\x85\x86.".to_vec()), 0..60),
        ) {
            let _ = Pickle::read(&picks);
        }
    }
}
